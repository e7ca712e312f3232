"""One file per further layer that a preset may name under ``layers:``, after the motion.

A layer is a module of this package with ``Options``, a frozen dataclass of its settings, and
``start(options, facts, splats, generator) -> Layer``. Layers never import one another.
"""

from __future__ import annotations

KIND = "layer"
