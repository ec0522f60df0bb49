"""Scores of generative models: how far a set of made pictures is from a set of real ones."""
