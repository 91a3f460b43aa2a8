"""Published results of our own studies (``uard.lab.views.published`` says what that is)."""
