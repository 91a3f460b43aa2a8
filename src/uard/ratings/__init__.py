"""Ratings: which rater gave which item which number; all that a mitigation sees is derived from them."""
