"""Rendra Lab: every classic task of 3D deep learning as one command, on Hydra and Lightning."""

import os

# How long a thread of GNU OpenMP spins before it sleeps. It is read when torch is loaded, so it stands here, in what
# every front door imports first. Torch and Numba have thread pools of their own. The usual 300,000 turns keep the
# cores from those that have work as soon as two such processes share a machine: both become 10 to 50 times slower.
# Without any, waking up costs up to two thirds more on an idle machine. 2,000, some 30 microseconds, avoid both.
if "OMP_WAIT_POLICY" not in os.environ:
    os.environ.setdefault("GOMP_SPINCOUNT", "2000")
