"""Threads and forks, each in a process of its own."""

import subprocess
import sys

import pytest

PROGRAM = """
import multiprocessing, sys, threading, torch
from rendra.kernels.soft_silhouette import soft_silhouette

def draw(_=0):
    faces = torch.tensor([[[-0.5, -0.5, 2.0], [0.5, -0.5, 2.0], [0.0, 0.5, 2.0]]])
    return float(soft_silhouette(faces, torch.tensor([0]), torch.tensor([1]), None, (8, 8), 1e-3, 1e-4, False).sum())

if __name__ == "__main__":
    mode = sys.argv[1]
    torch.set_num_threads(1)
    value = draw()
    assert torch.get_num_threads() == 1  # although Numba has started a thread for every core
    if mode == "threads":
        threads = [threading.Thread(target=lambda: [draw() for _ in range(50)]) for _ in range(4)]
        [t.start() for t in threads]
        [t.join() for t in threads]
    else:
        with multiprocessing.get_context(mode).Pool(1) as pool:
            try:
                assert pool.map(draw, [0]) == [value]
            except RuntimeError as error:
                assert "forkserver" in str(error), error
                print("refused")
    print("done")
"""


@pytest.mark.parametrize("mode", ["threads", "fork", "spawn"])
def test_kernels_survive(mode, tmp_path):
    """Four Python threads at once; a spawned worker; a forked worker, which works or is told what to do."""
    script = tmp_path / "program.py"
    script.write_text(PROGRAM)
    result = subprocess.run(
        [sys.executable, "-W", "ignore", str(script), mode],
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert result.returncode == 0, result.stderr
    assert result.stdout.endswith("done\n")
