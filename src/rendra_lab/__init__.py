"""Rendra Lab: every classic task of 3D deep learning as one command, on Hydra and Lightning."""

import os

# Threads that wait for work sleep instead of spinning. OpenMP reads this when torch is loaded, so it stands here, in
# what every front door imports first. Torch and Numba have thread pools of their own; spinning, they take the cores
# from each other as soon as a second job runs on the machine, and both become 10 to 50 times slower. Sleeping costs
# a tenth on an idle machine: OMP_WAIT_POLICY=active in the environment takes that back.
os.environ.setdefault("OMP_WAIT_POLICY", "passive")
