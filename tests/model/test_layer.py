"""A layer by itself: what it takes from a file and what it refuses; lists of layers in presets."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import pytest
import torch
from motion_checks import FACTS, splats_of
from torch import Tensor

from gsdmsr_cli.gaussians.moment import Moment
from gsdmsr_cli.ground.errors import UsageError
from gsdmsr_cli.model.building import check_layers, start_model
from gsdmsr_cli.model.layer import Instant, Layer
from gsdmsr_cli.model.parameter import Parameter


class Sample(Layer):
    """A row per splat, a table that all share, and indices into it that are not trained."""

    def __init__(self) -> None:
        super().__init__(
            [
                Parameter("rows", torch.zeros(1, 3), per_splat=True, rate="means"),
                Parameter("table", torch.zeros(4, 2), rate=(1e-2, 1e-3)),
                Parameter("indices", torch.zeros(4, dtype=torch.int64)),
            ]
        )

    def at(self, moment: Moment, instant: Instant) -> Moment:
        return moment

    def check(self) -> None:
        own = self.tensors()
        if len(own["table"]) != len(own["indices"]):
            raise ValueError(f"{len(own['table'])} entries for {len(own['indices'])} indices")


def file_of(entries: int = 6, count: int = 5) -> dict[str, Tensor]:
    return {
        "rows": torch.arange(3.0 * count).view(count, 3),
        "table": torch.arange(2.0 * entries).view(entries, 2),
        "indices": torch.arange(entries),
        "someone else's": torch.zeros(1),
    }


def test_values_and_shapes_come_from_the_file() -> None:
    layer, file = Sample(), file_of()
    before = layer.tensors()
    layer.restore(file, 5)
    for name, tensor in layer.tensors().items():
        assert tensor is before[name] and torch.equal(tensor, file[name]), name
        assert tensor.requires_grad == (name != "indices")
        assert tensor.data_ptr() != file[name].data_ptr(), "a copy, whatever becomes of the file"


REFUSED: dict[str, tuple[Mapping[str, Tensor | None], str]] = {
    "missing": ({"table": None}, "nothing for 'table'"),
    "of another kind": (
        {"indices": torch.zeros(6)},
        r"shape \(6,\) torch.float32 for 'indices', not 1 dimensions of torch.int64",
    ),
    "of other dimensions": (
        {"table": torch.zeros(12)},
        r"shape \(12,\) torch.float32 for 'table', not 2 dimensions of torch.float32",
    ),
    "of other splats": (
        {"rows": torch.zeros(4, 3)},
        r"shape \(4, 3\) torch.float32 for 'rows', not \(5, 3\)",
    ),
    "wider": ({"rows": torch.zeros(5, 2)}, r"shape \(5, 2\) .* for 'rows', not \(5, 3\)"),
    "not together": ({"table": torch.zeros(7, 2)}, "7 entries for 6 indices"),
}


@pytest.mark.parametrize(("change", "found"), REFUSED.values(), ids=REFUSED)
def test_what_does_not_fit_is_refused(change: Mapping[str, Tensor | None], found: str) -> None:
    file = {name: t for name, t in (file_of() | dict(change)).items() if t is not None}
    with pytest.raises(ValueError, match=f"^{found}$"):
        Sample().restore(file, 5)


def start(*layers: dict[str, Any]) -> None:
    generator = torch.Generator().manual_seed(0)
    start_model(splats_of(4), {"name": "static"}, layers, FACTS, generator)


def test_a_layer_that_is_not_there_is_told() -> None:
    for refuse in (lambda: start({"name": "fade"}), lambda: check_layers({"name": "static"}, [{}])):
        with pytest.raises(UsageError, match=r"^unknown layer '(fade)?'; "):
            refuse()
    with pytest.raises(UsageError, match=r"^unknown motion 'statik'; did you mean 'static'\?$"):
        check_layers({"name": "statik"}, [])
