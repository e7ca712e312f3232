"""A report as Markdown and as JUnit XML: every figure and verdict, whatever characters it has."""

from __future__ import annotations

from xml.etree import ElementTree

from reports import small_report

from gsdmsr_cli.evaluation.gates import Verdict
from gsdmsr_cli.evaluation.junit import junit
from gsdmsr_cli.evaluation.markdown import markdown
from gsdmsr_cli.evaluation.summary import machine

VERDICTS = [
    Verdict("psnr >= 25", True, "psnr is 26"),
    Verdict("ssim >= 0.9", False, 'a|b <i> & "c"'),
]


def cells(text: str) -> list[list[str]]:
    """Return the cells of all rows of all tables."""
    lines = [line.replace("\\|", "\0") for line in text.splitlines() if line.startswith("|")]
    return [[cell.strip().replace("\0", "|") for cell in line.split("|")[1:-1]] for line in lines]


def test_tables_hold_every_figure() -> None:
    document = small_report()
    found = cells(markdown("run", document, VERDICTS))
    assert ["psnr", "26.1235", "24.5000"] in found
    assert ["lpips_alex", "none: no weights <here>".replace("<", "&lt;")] == found_row(found, 2)
    assert ["train", "30.0000", "20"] in found and ["test", "26.1235", "2"] in found
    assert ["model", "1,234 splats, 1.50 MB"] in found
    assert ["**failed**", "ssim >= 0.9", 'a|b &lt;i> &amp; "c"'] in found
    assert ["passed", "psnr >= 25", "psnr is 26"] in found


def found_row(rows: list[list[str]], count: int) -> list[str]:
    return next(row[:count] for row in rows if row[0] == "lpips_alex")


def test_every_table_has_rows_of_one_width() -> None:
    for block in markdown("a | b", small_report(), VERDICTS).split("\n\n"):
        assert len({len(row) for row in cells(block)}) <= 1
    assert markdown("a | <b>", small_report(), []).startswith("## a \\| &lt;b>\n")


def test_junit_counts_and_names_failures() -> None:
    root = ElementTree.fromstring(junit("gsdmsr.eval", small_report(), VERDICTS))
    (suite,) = root.findall("testsuite")
    for element in (root, suite):
        assert (element.get("tests"), element.get("failures")) == ("2", "1")
    first, second = suite.findall("testcase")
    assert first.get("name") == "psnr >= 25" and first.find("failure") is None
    failure = second.find("failure")
    assert failure is not None and failure.get("message") == 'a|b <i> & "c"'
    properties = {p.get("name"): p.get("value") for p in suite.iter("property")}
    assert properties["psnr"] == "26.123456" and properties["lpips_alex"] == "None"


def test_the_machine_is_the_gpu_where_one_computes() -> None:
    document = small_report()
    assert machine(document) == "A <fast> & small CPU (cpu)"
    document["protocol"] |= {"gpu": "A GPU", "device": "cuda"}
    assert machine(document) == "A GPU (cuda)"
