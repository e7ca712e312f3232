"""The text of the page: one file that says what it may fetch, made of modules that fit together."""

from __future__ import annotations

import re
from importlib import resources

import pytest

from gsdmsr_cli.ground.splatting_constants import ALPHA_MIN
from gsdmsr_cli.player.page import SCRIPTS, page, script

FILES = resources.files("gsdmsr_cli.player")


def module(name: str) -> str:
    return FILES.joinpath(f"{name}.js").read_text("utf-8")


def test_every_module_is_in_the_page_and_none_imports_what_is_not() -> None:
    there = {path.name for path in FILES.iterdir() if path.name.endswith(".js")}
    assert there == {f"{name}.js" for name in SCRIPTS}
    for name in SCRIPTS:
        for names, source in re.findall(
            r'^import \{([^}]*)\} from "\./(\w+)\.js";', module(name), re.M
        ):
            for imported in re.split(r",\s*", names.strip()):
                assert re.search(rf"^export .*\b{imported}\b", module(source), re.M), imported
    left = re.findall(r"^(?:import|export)\b.*", script(), re.MULTILINE)
    assert not left


def test_no_two_modules_have_one_name_for_two_things() -> None:
    """For they share one scope, where a later function would replace an earlier; `int` is GLSL."""
    named = r"^(?:export )?(?:async )?(?:function|const|let|class) (?!int )(\w+)"
    names = [found for name in SCRIPTS for found in re.findall(named, module(name), re.MULTILINE)]
    assert len(names) > 60 and len(names) == len(set(names))


def test_nothing_in_the_script_ends_it() -> None:
    assert "</script" not in script().lower() and "<!--" not in script()
    assert f'"ALPHA_MIN": {ALPHA_MIN}' in script()


def test_a_page_that_holds_its_file_may_fetch_nothing() -> None:
    text = page(b"\x00\xff{url}", None, 'a <b> & "c" {data}')
    assert "connect-src 'none'" in text and "data-url" not in text
    assert "<title>a &lt;b&gt; &amp; &quot;c&quot; {data}</title>" in text
    assert '<script type="text/plain" id="file">AP97dXJsfQ==</script>' in text
    assert not re.findall(r'(?:src|href)="(?!data:,)', text)


@pytest.mark.parametrize(
    ("url", "origin"),
    [
        ("scene.dsplat", "'self'"), ("../a/b c.dsplat?x=1&y", "'self'"), ("/a.dsplat", "'self'"),
        ("https://example.org:81/a.dsplat", "https://example.org:81"),
    ],
)  # fmt: skip
def test_a_page_that_names_its_file_may_fetch_from_there(url: str, origin: str) -> None:
    text = page(None, url, "a")
    assert f"connect-src {origin}" in text
    assert f'data-url="{url.replace("&", "&amp;")}"' in text


def test_a_page_has_one_of_both() -> None:
    for data, url in ((None, None), (b"", "a")):
        with pytest.raises(ValueError, match="one of them"):
            page(data, url, "a")
