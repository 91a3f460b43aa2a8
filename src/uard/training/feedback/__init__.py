"""What a learner knows of its raters."""
