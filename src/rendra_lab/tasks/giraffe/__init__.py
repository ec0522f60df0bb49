"""GIRAFFE: scenes made of objects, learned from unposed pictures."""
