"""What passes and what does not, and which baselines are none."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gsdmsr_cli.evaluation.catalogue import FLICKER
from gsdmsr_cli.evaluation.gates import SAME, Threshold, read_gates
from gsdmsr_cli.evaluation.request import Demands
from gsdmsr_cli.ground.errors import DataError, UsageError

PROTOCOL = {
    "split": "test",
    "resolution": [400, 400],
    "background": "white",
    "data_fingerprint": "abc",
    "seed": 0,
    "conventions": {"psnr": "of everything"},
}


def report(**aggregate: Any) -> dict[str, Any]:
    return {"schema": 1, "protocol": PROTOCOL, "aggregate": aggregate}


def written(path: Path, document: Any) -> Path:
    path.write_text(json.dumps(document))
    return path


def distance(value: float | None) -> dict[str, Any]:
    return {"value": value, "reason": None, "searched": []}


numbers = st.floats(-1e3, 1e3)


@given(numbers, numbers)
def test_a_bound_is_the_least_or_the_most_itself_included(value: float, bound: float) -> None:
    assert Threshold("psnr", bound).judge({"psnr": value}).passed == (value >= bound)
    assert Threshold("lpips_alex", bound).judge({"lpips_alex": distance(value)}).passed == (
        value <= bound
    )


@pytest.mark.parametrize("aggregate", [{}, {"psnr": None}, {"psnr": distance(None)}])
def test_what_has_no_value_passes_nothing(aggregate: dict[str, Any], tmp_path: Path) -> None:
    verdict = Threshold("psnr", -1e9).judge(aggregate)
    assert not verdict.passed and "psnr has no value" in verdict.found
    earlier = written(tmp_path / "a.json", report(psnr=1.0))
    (verdict,) = read_gates(Demands(baseline=earlier)).judge({"aggregate": aggregate})
    assert not verdict.passed and verdict.found == "psnr has no value here"
    earlier = written(tmp_path / "a.json", report(**aggregate, ssim=0.5))
    gates = read_gates(Demands(baseline=earlier, tolerance=("psnr=100",)))
    (verdict,) = gates.judge(report(psnr=1e9))
    assert not verdict.passed and verdict.found == "psnr has no value in the baseline"


def test_without_tolerances_everything_must_be_as_good(tmp_path: Path) -> None:
    earlier = report(psnr=25.0, ssim=0.9, lpips_alex=distance(0.1), lpips_vgg=distance(None))
    gates = read_gates(Demands(baseline=written(tmp_path / "a.json", earlier)))
    assert [v.passed for v in gates.judge(earlier)] == [True, True, True]
    better = report(psnr=25.1, ssim=0.91, lpips_alex=distance(0.09))
    assert [v.passed for v in gates.judge(better)] == [True, True, True]
    worse = report(psnr=24.9, ssim=0.89, lpips_alex=distance(0.11))
    assert [v.passed for v in gates.judge(worse)] == [False, False, False]
    assert "psnr is 24.9 after 25 in the baseline" in gates.judge(worse)[0].found


def test_with_tolerances_only_these_metrics_are_compared(tmp_path: Path) -> None:
    earlier = written(tmp_path / "a.json", report(psnr=25.0, lpips_alex=distance(0.1), ssim=0.9))
    demands = Demands(baseline=earlier, tolerance=("psnr=0.5", "lpips_alex=0.02"))
    gates = read_gates(demands)
    for psnr, lpips, passed in ((24.6, 0.115, True), (24.4, 0.125, False)):
        verdicts = gates.judge(report(psnr=psnr, lpips_alex=distance(lpips), ssim=0.1))
        assert [verdict.passed for verdict in verdicts] == [passed, passed]


NO_NUMBERS = {
    "nothing": "{}",
    "null": '{"psnr": null, "ssim": {"value": null, "reason": "x"}}',
    "other names": '{"speed": 3}',
    "no value": '{"psnr": {}}',
}


@pytest.mark.parametrize("aggregate", NO_NUMBERS.values(), ids=NO_NUMBERS)
def test_a_baseline_with_which_nothing_can_be_compared_is_bad_data(
    aggregate: str, tmp_path: Path
) -> None:
    path = written(tmp_path / "a.json", report() | {"aggregate": json.loads(aggregate)})
    with pytest.raises(DataError, match=r"a\.json: has no number for any metric"):
        read_gates(Demands(baseline=path))


NOT_NUMBERS = "-Infinity", "NaN", "1e999", '"25"', "[25.0]", "true", '{"value": "x"}', "1" * 400


@pytest.mark.parametrize("value", NOT_NUMBERS)
@pytest.mark.parametrize("tolerance", [(), ("ssim=1",)])
def test_a_baseline_with_a_metric_that_is_no_number_is_bad_data(
    value: str, tolerance: tuple[str, ...], tmp_path: Path
) -> None:
    path = written(tmp_path / "a.json", report(psnr="?", ssim=0.5))
    path.write_text(path.read_text().replace('"?"', value))
    with pytest.raises(DataError, match=r"a\.json: damaged: ") as caught:
        read_gates(Demands(baseline=path, tolerance=tolerance))
    assert "\n" not in str(caught.value) and len(str(caught.value)) < 200 + len(str(path))


@pytest.mark.parametrize("key", ["conventions", "lpips_weights"])
def test_a_baseline_whose_conventions_are_none_is_bad_data(tmp_path: Path, key: str) -> None:
    document = report(psnr=25.0)
    document["protocol"] = PROTOCOL | {key: ["psnr"]}
    with pytest.raises(DataError, match=f"its {key} are no JSON object"):
        read_gates(Demands(baseline=written(tmp_path / "a.json", document)))


@pytest.mark.parametrize("key", SAME)
def test_a_baseline_of_another_protocol_is_refused(key: str, tmp_path: Path) -> None:
    gates = read_gates(Demands(baseline=written(tmp_path / "a.json", report(psnr=25.0))))
    assert gates.baseline is not None
    gates.baseline.require_same(PROTOCOL | {"seed": 5})
    changed = {"resolution": [800, 800]}.get(key, "other")
    with pytest.raises(DataError, match=f"its {key} is .*; a baseline must") as caught:
        gates.baseline.require_same(PROTOCOL | {key: changed})
    assert "\n" not in str(caught.value)


def test_pictures_and_weights_must_agree_where_both_state_them(tmp_path: Path) -> None:
    known = {"pictures_fingerprint": "12", "lpips_weights": {"alex": {"trunk": "ab"}, "vgg": None}}
    earlier = report(psnr=25.0) | {"protocol": PROTOCOL | known}
    for document, own in ((report(psnr=25.0), PROTOCOL | known), (earlier, PROTOCOL)):
        gates = read_gates(Demands(baseline=written(tmp_path / "a.json", document)))
        assert gates.baseline is not None
        gates.baseline.require_same(own)  # of before there was either
    gates.baseline.require_same(PROTOCOL | known | {"lpips_weights": {"vgg": {"trunk": "cd"}}})
    with pytest.raises(DataError, match="its pictures_fingerprint is '12', not '34' as here"):
        gates.baseline.require_same(PROTOCOL | known | {"pictures_fingerprint": "34"})
    with pytest.raises(DataError, match=r"its lpips_weights\.alex is"):
        gates.baseline.require_same(PROTOCOL | {"lpips_weights": {"alex": {"trunk": "cd"}}})


def test_conventions_must_agree_where_both_state_them(tmp_path: Path) -> None:
    gates = read_gates(Demands(baseline=written(tmp_path / "a.json", report(psnr=25.0))))
    assert gates.baseline is not None
    more = {"psnr": "of everything", "ms_ssim": "new"}
    gates.baseline.require_same(PROTOCOL | {"conventions": more})
    with pytest.raises(DataError, match=r"conventions\.psnr"):
        gates.baseline.require_same(PROTOCOL | {"conventions": {"psnr": "of red alone"}})


USAGE = {
    "unknown": (Demands(fail_under=("pnsr=3",)), "--fail-under pnsr=3: no such metric; did you"),
    "no number": (Demands(fail_over=("lpips_vgg=low",)), "allowed: METRIC=NUMBER"),
    "infinite": (Demands(fail_under=("psnr=inf",)), "allowed: METRIC=NUMBER"),
    "wrong way": (Demands(fail_under=("lpips_alex=1",)), "use --fail-over lpips_alex=1"),
    "wrong way too": (Demands(fail_over=("psnr_moving=1",)), "use --fail-under psnr_moving=1"),
    "no baseline": (Demands(tolerance=("psnr=1",)), "--tolerance psnr=1 needs a --baseline"),
}


@pytest.mark.parametrize(("demands", "message"), USAGE.values(), ids=USAGE)
def test_demands_that_make_no_sense_are_refused(demands: Demands, message: str) -> None:
    with pytest.raises(UsageError, match=message):
        read_gates(demands)


def test_a_tolerance_is_not_negative(tmp_path: Path) -> None:
    earlier = written(tmp_path / "a.json", report(psnr=25.0))
    exact = read_gates(Demands(baseline=earlier, tolerance=("psnr=0",)))
    for psnr, passed in ((25.0, True), (24.999, False)):
        assert [verdict.passed for verdict in exact.judge(report(psnr=psnr))] == [passed]
    with pytest.raises(UsageError, match="psnr=-1: allowed: 0 or more"):
        read_gates(Demands(baseline=earlier, tolerance=("psnr=-1",)))


@pytest.mark.parametrize(
    "content",
    ["{", "[]", "{}", '{"protocol": {}, "aggregate": 3}', '{"protocol": {}, "aggregate": {}}'],
)
def test_a_baseline_that_is_no_report_is_bad_data(content: str, tmp_path: Path) -> None:
    (tmp_path / "a.json").write_text(content)
    with pytest.raises(DataError, match=r"a\.json: ") as caught:
        read_gates(Demands(baseline=tmp_path / "a.json"))
    assert "\n" not in str(caught.value)


def test_flicker_of_the_true_pictures_is_no_demand(tmp_path: Path) -> None:
    """Nor is a run worse than a baseline by it; by its own flicker it is."""
    with pytest.raises(UsageError, match="flicker_true is of the true pictures, which no run"):
        read_gates(Demands(fail_over=("flicker_true=0.1",)))
    with pytest.raises(UsageError, match="less flicker is better; use --fail-over"):
        read_gates(Demands(fail_under=("flicker=0.1",)))
    known = {name: distance(0.01) for name in FLICKER}
    gates = read_gates(Demands(baseline=written(tmp_path / "a.json", report(**known))))
    more = {name: distance(0.02) for name in FLICKER}
    verdicts = gates.judge({"aggregate": more})
    assert [v.name.split()[0] for v in verdicts] == ["flicker", "flicker_excess"]
    assert not any(verdict.passed for verdict in verdicts)
    assert all(verdict.passed for verdict in gates.judge({"aggregate": known}))
