"""One file per motion: how splats move over time.

A motion is a module of this package with ``Options``, a frozen dataclass of its settings, and
``start(options, facts, splats, generator) -> Layer``. It is the first layer of a model. Motions
never import one another; what they share lies in files with a
leading underscore and in ``gsdmsr_cli.ops``.
"""
