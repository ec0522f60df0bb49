"""Samples along rays where the density is; `rendra.ops.sample_pdf` says how, `sample_pdf` here is the same."""

from torch import Tensor

from rendra.ops.sample_pdf import sample_pdf

__all__ = ["sample_pdf", "sample_pdf_python"]


def sample_pdf_python(bins: Tensor, weights: Tensor, N_samples: int, det: bool = False, eps: float = 1e-5) -> Tensor:
    """`sample_pdf` under the name, and with the argument name, of scripts that wanted the differentiable one."""
    return sample_pdf(bins, weights, N_samples, det, eps)
