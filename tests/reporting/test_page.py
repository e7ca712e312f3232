"""The page: one well-formed file that asks for nothing else and says what the report says."""

from __future__ import annotations

import re
from html.parser import HTMLParser
from typing import Any

import pytest
from report_pages import LOG, SHOWN_FRAMES
from reports import small_report

from gsdmsr_cli.evaluation.gates import Verdict
from gsdmsr_cli.reporting.markup import at
from gsdmsr_cli.reporting.page import page

VOID = {"meta", "img", "input", "br", "link", "hr"}


class Reader(HTMLParser):
    """Collects what a page holds, and holds every tag to be closed where it was opened."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.addresses: list[str] = []
        self.figures: list[tuple[str, str, str]] = []
        self.ids: list[str] = []
        self.texts: list[str] = []
        self._figure: tuple[str, str] | None = None

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = dict(attrs)
        self.addresses += [given[key] or "" for key in ("src", "href", "data") if key in given]
        self.ids += [given["id"] or ""] if "id" in given else []
        if tag == "data":
            self._figure = given["data-of"] or "", given["value"] or ""
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        pass  # of SVG

    def handle_endtag(self, tag: str) -> None:
        assert self.open and self.open.pop() == tag, (tag, self.getpos())

    def handle_data(self, data: str) -> None:
        self.texts.append(data)
        if self._figure is not None:
            self.figures.append((*self._figure, data))
            self._figure = None


def read(text: str) -> Reader:
    reader = Reader()
    reader.feed(text)
    reader.close()
    assert not reader.open
    return reader


def made(**changes: Any) -> str:
    document = small_report() | changes
    return page("a <run>", document, [Verdict("x", False, "a & b")], LOG, SHOWN_FRAMES, 0.1)


def test_the_page_is_well_formed_and_asks_for_nothing_else() -> None:
    text = made()
    reader = read(text)
    assert reader.addresses and all(a.startswith("data:image/webp") for a in reader.addresses)
    assert set(re.findall(r"https?://[^\"'\s)]+", text)) == {"http://www.w3.org/2000/svg"}
    assert "@import" not in text and "url(" not in text
    assert "default-src 'none'" in text
    assert len(set(reader.ids)) == len(reader.ids)
    assert not re.search(r"\b(nan|inf|None|undefined)\b", "".join(reader.texts))


def test_the_page_links_to_the_one_that_plays() -> None:
    given = "r", small_report(), [], LOG, SHOWN_FRAMES, 0.1
    linked = [a for a in read(page(*given, "play&.html")).addresses if not a.startswith("data:")]
    assert linked == ["play&.html"]


def test_every_figure_is_one_of_the_report() -> None:
    document, reader = small_report(), read(made())
    for path, value, text in reader.figures:
        stands = at(document, path)
        assert float(value) == stands, path
        scale = 1e6 if path.startswith("storage.") else 1.0
        digits = len(text.partition(".")[2])
        rounded = float(text.replace(",", ""))
        assert rounded == pytest.approx(stands / scale, abs=0.5000001 * 10**-digits), path
    shown = {path for path, _, _ in reader.figures}
    assert {
        "aggregate.psnr", "aggregate.ms_ssim.value", "backgrounds.black.aggregate.psnr",
        "splits.train.psnr", "splits.test.psnr", "splits.val.frames", "frames.0.psnr",
        "frames.1.ssim", "speed.fps", "speed.fps_raster", "training.train_s",
        "training.stages_s.gradients", "training.stages_s.other", "training.compile_s",
        "storage.splats_bytes", "storage.motion_bytes", "storage.checkpoint_bytes",
    } <= shown  # fmt: skip


def test_text_stays_text_and_reasons_and_verdicts_are_told() -> None:
    text = "".join(read(made()).texts)
    for told in ("a <run>", "a & b", "failed", "no weights <here>", "A <fast> & small CPU"):
        assert told in text, told
    assert "3.88 dB more" in text  # train less test


@pytest.mark.parametrize(
    ("there", "shown"),
    [("alex vgg squeeze", "alex"), ("squeeze vgg", "vgg"), ("squeeze", "squeeze")],
)
def test_one_lpips_is_shown_large(there: str, shown: str) -> None:
    """The first that has a value; papers give those of alex and vgg."""
    values = {
        f"lpips_{net}": {"value": 0.1, "reason": None, "searched": []} for net in there.split()
    }
    document = small_report()
    aggregate = {k: v for k, v in document["aggregate"].items() if "lpips" not in k} | values
    text = made(aggregate=aggregate)
    tiles = [net for net in ("alex", "vgg", "squeeze") if f"LPIPS, {net}" in text]
    assert tiles == [shown]


def test_what_layers_did_to_views_is_told_also_by_segment() -> None:
    exposure = {"about": "colours", "per": "picture", "own": 3, "of_neighbours": 2, "none": 1}
    motion = {"about": "shown later", "time_offsets": [0.25, -0.75, 0.0]}
    one = {"exposure": exposure, "motion": motion}
    for views, before in ((one, ""), ({"0": one, "1": {"motion": motion}}, "segment 1, ")):
        texts = read(made(protocol=small_report()["protocol"] | {"views": views})).texts
        assert f"{before}motion" in texts
        assert "shown later; by at most 0.75 frames earlier or later" in texts
        told = "colours; of the split 3 have their own, 2 that of neighbours, 1 none"
        assert told in texts


def test_charts_have_titles_and_axes() -> None:
    charts = re.findall(r"<svg.*?</svg>", made(), re.DOTALL)
    assert len(charts) == 3
    for chart in charts:
        assert re.search(r'role="img" aria-label="[^"]+"', chart)
        assert "of training" in chart or "time in the scene" in chart


def test_a_page_without_log_stills_stages_or_demands_leaves_these_out() -> None:
    document = small_report() | {"backgrounds": {}}
    document["training"] = {"steps": 3, "train_s": 1.0, "splats": 2, "stages_s": {}}
    document["frames"] = document["frames"][:1]
    document["aggregate"] = {"psnr": None, "ssim": 0.5}
    document["splits"] = {"test": {"psnr": None, "frames": 1}}
    text = page("r", document, [], [], [], 1.0)
    read(text)
    assert "<svg" not in text and "Asked for" not in text and "Worst" not in text
