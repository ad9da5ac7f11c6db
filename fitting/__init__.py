"""Inverse design of hair: which numbers of a scene give a wanted curl."""
