"""TorchScript archives are read as data: tensors come back, calls are refused."""

from __future__ import annotations

import io
import os
import pickle
import zipfile

import numpy as np
import pytest
import torch

from lightsim.errors import InputError
from lightsim_lab.metrics.torchscript import read_script_modules


class Outer(torch.nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.layer = torch.nn.Linear(3, 2)
        self.stride = 2

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return self.layer(x) * self.stride


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_tensors_and_attributes_come_back_by_path() -> None:
    module = Outer()
    stream = io.BytesIO()
    torch.jit.save(torch.jit.script(module), stream)
    found = read_script_modules(stream.getvalue())
    assert found[""]["stride"] == 2
    for name, tensor in module.layer.named_parameters():
        np.testing.assert_array_equal(found["layer"][name], tensor.detach().numpy())


class Harmful:
    def __reduce__(self) -> tuple:
        return os.getpid, ()


@pytest.mark.parametrize("value", [Harmful(), torch.nn.Linear])
def test_calls_are_refused(value: object) -> None:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as archive:
        archive.writestr("top/data.pkl", pickle.dumps(value))
    with pytest.raises(InputError, match="refused"):
        read_script_modules(stream.getvalue())


def test_what_is_no_archive_is_said(tmp_path: object) -> None:
    with pytest.raises(InputError, match="cannot be read"):
        read_script_modules(b"no zip")
