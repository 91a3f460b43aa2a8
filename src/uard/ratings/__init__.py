"""Ratings: who said what of which item; everything that a mitigation sees is derived from it."""
