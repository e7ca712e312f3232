"""Sets reports of several evaluations side by side."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from gsdmsr_cli.evaluation.catalogue import METRICS, OF_TRUTH, less_is_better
from gsdmsr_cli.evaluation.gates import differences
from gsdmsr_cli.evaluation.summary import Document, machine, value_of


@dataclass(frozen=True)
class Compared:
    """One report among others.

    Attributes:
        name: what it is called in tables.
        document: the report.
        differs: in which points its protocol differs from that of the first; figures of such a
            report are not comparable with the others.
    """

    name: str
    document: Document
    differs: tuple[str, ...]

    def plain(self) -> dict[str, Any]:
        """Return the figures that are compared, plain JSON."""
        about, training = self.document["protocol"], self.document["training"]
        stored = self.document["storage"]
        return {
            "name": self.name,
            "comparable": not self.differs,
            "differs": list(self.differs),
            **{key: about.get(key) for key in ("preset", "motion", "seed", "data_fingerprint")},
            **{key: about.get(key) for key in ("split", "resolution", "background")},
            "metrics": {metric: value_of(self.document["aggregate"], metric) for metric in METRICS},
            "train_s": training["train_s"],
            "steps": training["steps"],
            "splats": training["splats"],
            "model_bytes": stored["splats_bytes"] + stored["motion_bytes"],
            "fps": self.document["speed"]["fps"],
            "machine": machine(self.document),
        }


def compare(documents: Mapping[str, Document]) -> list[Compared]:
    """Return the reports with what makes them incomparable with the first."""
    first = next(iter(documents.values()))["protocol"]
    return [
        Compared(name, document, tuple(differences(first, document["protocol"])))
        for name, document in documents.items()
    ]


def rows_of(compared: Sequence[Compared]) -> list[tuple[str, ...]]:
    """Return what is compared and what each has of it; a star marks the best that is comparable."""
    plain = [one.plain() for one in compared]
    metrics = [m for m in METRICS if any(p["metrics"][m] is not None for p in plain)]
    rows = [("preset", *(str(p["preset"]) for p in plain))]
    rows += [(m, *_figures([p["metrics"][m] for p in plain], compared, m)) for m in metrics]
    for name, form, key, scale in (
        ("training [s]", ".0f", "train_s", 1), ("steps", ",", "steps", 1),
        ("splats", ",", "splats", 1), ("model [MB]", ".2f", "model_bytes", 1e6),
        ("frames a second", ".1f", "fps", 1),
    ):  # fmt: skip
        values = [p[key] / scale if scale != 1 else p[key] for p in plain]
        rows.append((name, *(f"{value:{form}}" for value in values)))
    rows.append(("on", *(str(p["machine"]) for p in plain)))
    if any(one.differs for one in compared):
        rows.append(("other protocol", *(", ".join(one.differs) or "" for one in compared)))
    return rows


def _figures(
    values: Sequence[float | None], compared: Sequence[Compared], metric: str
) -> list[str]:
    """Return the values as text; the best of those that are comparable has a star."""
    rivals = [
        v for v, one in zip(values, compared, strict=True) if v is not None and not one.differs
    ]
    best = (min if less_is_better(metric) else max)(rivals, default=None)
    texts = []
    for value, one in zip(values, compared, strict=True):
        judged = len(rivals) > 1 and metric not in OF_TRUTH
        star = " *" if judged and value == best and not one.differs else ""
        texts.append("none" if value is None else f"{value:.4f}{star}")
    return texts


def most_disputed(compared: Sequence[Compared], count: int) -> list[str]:
    """Return the frames whose PSNR differs most between the reports, in the first one's order."""
    scores = [{f["name"]: f["psnr"] for f in one.document["frames"]} for one in compared]
    shared = [name for name in scores[0] if all(own.get(name) is not None for own in scores)]
    spread = {name: max(s[name] for s in scores) - min(s[name] for s in scores) for name in shared}
    chosen = sorted(shared, key=lambda name: -spread[name])[:count]
    return [name for name in shared if name in chosen]
