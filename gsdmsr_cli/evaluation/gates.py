"""Checks metrics against thresholds and against an earlier evaluation."""

from __future__ import annotations

import math
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gsdmsr_cli.evaluation.catalogue import METRICS, OF_TRUTH, less_is_better
from gsdmsr_cli.evaluation.request import Demands
from gsdmsr_cli.evaluation.summary import SCHEMA, value_of
from gsdmsr_cli.ground.errors import DataError, UsageError, nearest
from gsdmsr_cli.ground.files import read_json

SAME = ("split", "resolution", "background", "data_fingerprint")
"""What two reports must agree in for their figures to be comparable."""


SAME_WHERE_KNOWN = ("pictures_fingerprint",)
"""What they must agree in if both say it; those of earlier versions do not."""


def differences(
    one: Mapping[str, Any], other: Mapping[str, Any]
) -> dict[str, tuple[object, object]]:
    """Return in which points two protocols differ so that figures cannot be compared."""
    own, others = _compared(one), _compared(other)
    shared = [key for key in own if key in others]
    return {key: (own[key], others[key]) for key in shared if own[key] != others[key]}


@dataclass(frozen=True)
class Verdict:
    """The result of one check.

    Attributes:
        name: of the check, such as "psnr >= 25".
        passed: its result.
        found: the value that was found, as a clause.
    """

    name: str
    passed: bool
    found: str


@dataclass(frozen=True)
class Threshold:
    """A value that a metric must reach, or, where less is better, must not exceed."""

    metric: str
    value: float

    def judge(self, aggregate: Mapping[str, Any]) -> Verdict:
        """Return the verdict on a report's aggregate; without a value nothing passes."""
        value, less = value_of(aggregate, self.metric), less_is_better(self.metric)
        name = f"{self.metric} {'<=' if less else '>='} {self.value:g}"
        wanted = f"wanted {self.value:g} or {'less' if less else 'more'}"
        if value is None:
            return Verdict(name, False, f"{self.metric} has no value, {wanted}")
        passed = value <= self.value if less else value >= self.value
        return Verdict(name, passed, f"{self.metric} is {value:.6g}, {wanted}")


@dataclass(frozen=True)
class Baseline:
    """An earlier report than which no metric may be worse.

    Attributes:
        path: where it was read.
        document: the report.
        tolerances: by metric, how much worse it may be. Without any, every metric that the
            baseline has a number for must be as good.
    """

    path: Path
    document: Mapping[str, Any]
    tolerances: Mapping[str, float]

    def require_same(self, protocol: Mapping[str, Any]) -> None:
        """Raise DataError unless a report with this protocol can be compared with the baseline."""
        for key, (own, other) in differences(protocol, self.document["protocol"]).items():
            raise DataError(
                f"{self.path}: its {key} is {_shown(other)}, not {_shown(own)} as here; a baseline "
                "must have been measured by the same protocol"
            )

    def judge(self, aggregate: Mapping[str, Any]) -> list[Verdict]:
        """Return a verdict on every metric that is compared."""
        earlier = self.document["aggregate"]
        compared = (metric for metric in METRICS if metric not in OF_TRUTH)
        numbered = (metric for metric in compared if value_of(earlier, metric) is not None)
        tolerances = self.tolerances or dict.fromkeys(numbered, 0.0)
        return [self._judge(metric, t, aggregate) for metric, t in tolerances.items()]

    def _judge(self, metric: str, tolerance: float, aggregate: Mapping[str, Any]) -> Verdict:
        now, before = value_of(aggregate, metric), value_of(self.document["aggregate"], metric)
        name = f"{metric} within {tolerance:g} of the baseline"
        if now is None or before is None:
            whose = "here" if now is None else "in the baseline"
            return Verdict(name, False, f"{metric} has no value {whose}")
        worse = now - before if less_is_better(metric) else before - now
        found = f"{metric} is {now:.6g} after {before:.6g} in the baseline"
        return Verdict(name, worse <= tolerance, f"{found}, wanted at most {tolerance:g} worse")


@dataclass(frozen=True)
class Gates:
    """All checks of a report; none by default."""

    bounds: Sequence[Threshold] = ()
    baseline: Baseline | None = None

    def judge(self, document: Mapping[str, Any]) -> list[Verdict]:
        """Return a verdict for every check."""
        aggregate = document["aggregate"]
        verdicts = [bound.judge(aggregate) for bound in self.bounds]
        return verdicts + (self.baseline.judge(aggregate) if self.baseline else [])


def read_gates(demands: Demands) -> Gates:
    """Return the checks that the options of the command line ask for.

    Raises:
        UsageError: a text names no metric or no number, or the metric is better the other way; or
            there are tolerances without a baseline.
        DataError: the baseline is not a report.
    """
    bounds = [_threshold("--fail-under", text, less=False) for text in demands.fail_under]
    bounds += [_threshold("--fail-over", text, less=True) for text in demands.fail_over]
    path = demands.baseline
    if path is None:
        if demands.tolerance:
            raise UsageError(f"--tolerance {demands.tolerance[0]} needs a --baseline")
        return Gates(bounds)
    tolerances = dict(_number("--tolerance", text) for text in demands.tolerance)
    for metric, value in tolerances.items():
        if value < 0:
            raise UsageError(f"--tolerance {metric}={value:g}: allowed: 0 or more")
    return Gates(bounds, Baseline(path, read_report(path), tolerances))


def _compared(protocol: Mapping[str, Any]) -> dict[str, Any]:
    """Return what is compared of a report's protocol, where the other has the same keys."""
    known = {key: protocol[key] for key in SAME_WHERE_KNOWN if protocol.get(key) is not None}
    conventions, weights = protocol.get("conventions", {}), protocol.get("lpips_weights", {})
    return (
        {key: protocol.get(key) for key in SAME}
        | known
        | {f"conventions.{key}": text for key, text in conventions.items()}
        | {f"lpips_weights.{net}": hashes for net, hashes in weights.items() if hashes}
    )


def _threshold(option: str, text: str, less: bool) -> Threshold:
    metric, value = _number(option, text)
    if less_is_better(metric) != less:
        better, other = ("more", "--fail-under") if less else ("less", "--fail-over")
        raise UsageError(f"{option} {text}: {better} {metric} is better; use {other} {text}")
    return Threshold(metric, value)


def _number(option: str, text: str) -> tuple[str, float]:
    """Return the metric and the number of "metric=value"."""
    metric, equals, value = text.partition("=")
    if equals and metric not in METRICS:
        raise UsageError(f"{option} {text}: no such metric; {nearest(metric, METRICS)}")
    if metric in OF_TRUTH:
        raise UsageError(
            f"{option} {text}: {metric} is of the true pictures, which no run changes; use flicker "
            "or flicker_excess"
        )
    try:
        number = float(value)
    except ValueError:
        number = math.nan
    if not math.isfinite(number):
        raise UsageError(f"{option} {text}: allowed: METRIC=NUMBER, as in psnr=25")
    return metric, number


def read_report(path: Path) -> dict[str, Any]:
    """Return a report of ``gsdmsr eval``.

    Raises:
        DataError: the file cannot be read, or is no report with numbers.
    """
    document = read_json(path)
    if not all(isinstance(document.get(key), dict) for key in ("protocol", "aggregate")):
        raise DataError(f"{path}: is not a report of eval; give a metrics.json that it has written")
    if document.get("schema") != SCHEMA:
        raise DataError(f"{path}: has schema {document.get('schema')}; this version reads {SCHEMA}")
    for key in ("conventions", "lpips_weights"):
        if not isinstance(document["protocol"].get(key, {}), dict):
            raise DataError(f"{path}: damaged: its {key} are no JSON object")
    for metric in METRICS:
        _require_number(path, metric, document["aggregate"].get(metric))
    if all(value_of(document["aggregate"], metric) is None for metric in METRICS):
        raise DataError(f"{path}: has no number for any metric, so nothing is compared with it")
    return document


def _require_number(path: Path, metric: str, entry: object) -> None:
    """Raise DataError unless a report's entry of a metric is a finite number or has none."""
    value = entry.get("value") if isinstance(entry, dict) else entry
    if value is not None and not _is_finite(value):
        found = repr(value)
        found = found if len(found) <= 40 else f"{found[:40]} ..."
        raise DataError(f"{path}: damaged: its {metric} is {found}; allowed: a number or null")


def _is_finite(value: object) -> bool:
    """Return whether a value is a number, of those that a float can have; a bool is none."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return False
    return abs(value) <= sys.float_info.max


def _shown(value: object) -> str:
    if isinstance(value, list):
        return " x ".join(map(str, value))
    return f"'{value}'"
