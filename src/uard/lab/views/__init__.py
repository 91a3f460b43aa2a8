"""What the store says, set against the paper: tables, figures, the ledger of claims, the page."""
