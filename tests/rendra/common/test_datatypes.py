"""Devices by name."""

import torch

from rendra.common.datatypes import get_device, make_device


def test_devices_by_name_and_by_tensor() -> None:
    assert make_device("cpu") == make_device(torch.device("cpu")) == torch.device("cpu")
    assert get_device(torch.zeros(1, device="meta")) == torch.device("meta")
    assert get_device(torch.zeros(1, device="meta"), "cpu") == torch.device("cpu")
    assert get_device([1.0]) == torch.device("cpu")
