"""Files written by hand from the page of the format: the package and the player read the same."""

from __future__ import annotations

import base64
import json

import files_by_hand as by_hand
import numpy as np
import pytest
import torch
from chromium import Chromium
from files_by_hand import File

from gsdmsr_cli.moving.container import from_bytes
from gsdmsr_cli.moving.decoding import decoded
from gsdmsr_cli.moving.playing import model_of
from gsdmsr_cli.player.page import _module

FILES = {
    "still": lambda: by_hand.still(40, 3),
    "no splat": lambda: by_hand.still(0),
    "bodies": lambda: by_hand.with_bodies(9, 0, degree=0),
    "lives": by_hand.with_lives,
    "everything": by_hand.with_everything,
}


@pytest.mark.parametrize("name", FILES)
def test_the_packages_reader_moves_splats_as_the_page_of_the_format_says(name: str) -> None:
    file = FILES[name]()
    model = model_of(decoded(*from_bytes(file.encode())))
    for time in (0.0, 0.37, 1.0):
        found, expected = model.at(model.instant(time)).splats.detach(), file.at(time)
        signs = (found.quats.double() * expected.quats).sum(1, keepdim=True).sign()
        lengths = [s.quats.norm(dim=1, keepdim=True) for s in (found, expected)]
        torch.testing.assert_close(
            (found.quats / lengths[0] * signs).double(), expected.quats / lengths[1],
            atol=1e-4, rtol=0,
        )  # fmt: skip
        for part in ("means", "log_scales", "sh"):
            torch.testing.assert_close(
                getattr(found, part).double(), getattr(expected, part), atol=1e-4, rtol=1e-4
            )
        opacities = [s.logit_opacities.sigmoid().double() for s in (found, expected)]
        torch.testing.assert_close(*opacities, atol=1e-4, rtol=0)


def decoded_by_page(browser: Chromium, data: bytes) -> dict[str, list[float]]:
    """Return the values of all parts that the page's decoder finds."""
    text = base64.b64encode(data).decode()
    found = browser.evaluate(
        f"""(async () => {{
        {_module("decode")}
        const bytes = Uint8Array.from(atob("{text}"), (letter) => letter.charCodeAt(0));
        const {{ parts }} = await decode(bytes);
        return JSON.stringify(Object.fromEntries([...parts].map(([k, v]) => [k, [...v.values]])));
        }})()"""
    )
    return dict(json.loads(found))


@pytest.mark.parametrize("name", FILES)
def test_the_page_decodes_every_part(browser: Chromium, name: str) -> None:
    file: File = FILES[name]()
    found = decoded_by_page(browser, file.encode())
    assert found.keys() == file.tables.keys()
    for part, table in file.tables.items():
        np.testing.assert_allclose(found[part], table.ravel(), rtol=1e-6, atol=1e-6, err_msg=part)
