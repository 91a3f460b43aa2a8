"""A language of forty words in which a model can be over-optimised within a minute, and whose worth a program knows."""
