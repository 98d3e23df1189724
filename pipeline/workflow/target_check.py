"""A check of a target with a progress bar."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from deploy.check.bundle import Bundle
    from deploy.check.results import CheckResult
    from deploy.targets.options import Options


@dataclass(frozen=True)
class TargetCheck:
    """A target, and what it is run with.

    Attributes
    ----------
    target : str
    seed : int
        Given to the simulator.
    options : Options or None
        See :func:`deploy.targets.registry.select_options`.
    """

    target: str
    seed: int
    options: Options | None = None

    def run(self, bundle: Bundle, path: Path) -> CheckResult:
        """Run the target on a bundle's samples, with a progress bar; write the result."""
        from deploy.check.run import run_check
        from pipeline.progress import progress

        with progress(f"check {self.target}", len(bundle.checks)) as advance:
            return run_check(bundle, self.target, path, self.seed, advance, self.options)
