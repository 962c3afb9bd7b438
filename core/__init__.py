"""The nouns of orthostream: pure functions from arrays and bytes to values."""
