"""Finds the options of a new training: its preset is named, or follows from the data."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from gsdmsr_cli.formats import suited_preset
from gsdmsr_cli.options.preset import Preset, load_preset
from gsdmsr_cli.options.preset_files import named_preset
from gsdmsr_cli.scene.scene import Scene
from gsdmsr_cli.training.trainer import check_plugins


@dataclass(frozen=True)
class Choice:
    """What the command line says of the options of a training.

    Attributes:
        preset: the preset that it names, or None.
        config: its file of options, or None.
        overrides: its "a.b=value" texts.
    """

    preset: str | None
    config: Path | None
    overrides: Sequence[str]

    @property
    def named(self) -> bool:
        """Whether the command line, or its file, names a preset."""
        return named_preset(self.preset, self.config) is not None

    def check(self) -> Preset:
        """Return the options as far as they are known before the data is read.

        Raises:
            UsageError: an option does not exist or is out of range.
        """
        if self.named:
            check_plugins(self._given)
        return self._given

    def suit(self, scene: Scene) -> Chosen:
        """Return the options of a training on ``scene``.

        Raises:
            UsageError: an option does not exist or is out of range.
        """
        if self.named:
            return Chosen(self._given, self.preset or self._file or "default", None)
        suited = suited_preset(scene)
        options = load_preset(suited.name, self.config, self.overrides)
        check_plugins(options)
        reason = f"preset {suited.name}, since {suited.reason}"
        return Chosen(options, self._file or suited.name, reason)

    @cached_property
    def _given(self) -> Preset:
        return load_preset(self.preset, self.config, self.overrides)

    @property
    def _file(self) -> str | None:
        return None if self.config is None else self.config.name


@dataclass(frozen=True)
class Chosen:
    """The options of a training.

    Attributes:
        options: all of them.
        name: of the preset, or of the file of options, for reports.
        reason: which preset follows from the data, and why; None where it was named.
    """

    options: Preset
    name: str
    reason: str | None
