"""Unseen space: surfaces at the edges of the field of view continue beyond them."""
