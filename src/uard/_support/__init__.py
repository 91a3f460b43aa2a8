"""What every floor may need and no user asks for."""
