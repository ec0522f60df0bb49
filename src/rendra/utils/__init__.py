"""Shapes to start from."""

from rendra.utils.ico_sphere import ico_sphere
from rendra.utils.torus import torus

__all__ = ["ico_sphere", "torus"]
