"""Kernels: raw tensors in, raw tensors out; one folder an operation.

Each folder holds the contract (`__init__.py`: validation, operator registration, autograd), the specification
(`reference.py`: plain torch, slow, obvious, any device), the fast twin (`numba_cpu.py`) and the derivation of the
backward pass (`README.md`). CPU tensors of float32 take the Numba kernel; everything else takes the reference,
which works in chunks of bounded memory.
"""
