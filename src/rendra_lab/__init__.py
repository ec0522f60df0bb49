"""Rendra Lab: every classic task of 3D deep learning as one command, on Hydra and Lightning."""
