"""The verbs of orthostream: one file per stage, read in flow order."""
