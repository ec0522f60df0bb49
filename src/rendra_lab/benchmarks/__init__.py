"""The operations that `scripts/benchmark.py` times.

An operation of the public API is written once against a `Library`, which is rendra or PyTorch3D: the same calls on
the same input. Steps of tasks and whole commands are rendra's alone.
"""

from rendra_lab.benchmarks.bodies import BODIES
from rendra_lab.benchmarks.geometry import GEOMETRY
from rendra_lab.benchmarks.giraffe import GIRAFFE
from rendra_lab.benchmarks.points import POINTS
from rendra_lab.benchmarks.radiance import RADIANCE
from rendra_lab.benchmarks.rays import RAYS
from rendra_lab.benchmarks.rendering import RENDERING
from rendra_lab.benchmarks.splats import SPLATS
from rendra_lab.benchmarks.volumes import VOLUMES

BENCHMARKS = (*RENDERING, *GEOMETRY, *RADIANCE, *RAYS, *POINTS, *SPLATS, *VOLUMES, *BODIES, *GIRAFFE)
