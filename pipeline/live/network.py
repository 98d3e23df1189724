"""The network of the page: from a run or from a bundle, if it is for the page's skin."""

from __future__ import annotations

from pathlib import Path

from deploy.check.bundle import Bundle, read_bundle
from deploy.errors import UserError
from pipeline.recordings.events import GRID
from pipeline.run.folder import RunFolder
from pipeline.settings import Image, read_settings

SHIPPED = Path(__file__).with_name("bundle")
"""The bundle on events that comes with this package; ``make shipped-bundle`` makes it, from the
settings of ``shipped.toml``."""


def network_of_bundle(folder: Path) -> tuple | None:
    """The bundle in a folder copied from anywhere, and how events become its images.

    Returns
    -------
    (Bundle, Image) or None
        None if there is no bundle.

    Raises
    ------
    UserError
        The bundle is damaged.
    """
    if not (folder / "MANIFEST.json").exists():
        return None
    return _with_images(read_bundle(folder), Image())


def network_of_run(run: RunFolder) -> tuple | None:
    """The same of a run; None if its bundle has not been made yet."""
    if not run.bundle.exists():
        return None
    known = run.experiment.exists()
    otherwise = read_settings(run.experiment).image if known else Image()
    return _with_images(read_bundle(run.bundle), otherwise)


def _with_images(bundle, otherwise):
    """With what the bundle says of its images; bundles of before say nothing."""
    said = bundle.spec.provenance.get("image")
    try:
        return bundle, otherwise if said is None else Image(**said)
    except TypeError as error:
        raise UserError(
            f"{bundle.path}: its images are made in an unknown way ({error})"
        ) from error


def fits_the_page(bundle: Bundle):
    """Refuse a network that is not for the page's skin and the ten digits.

    Raises
    ------
    UserError
        It is for other taxels or classes.
    """
    shape, classes = bundle.spec.input_shape[:2], bundle.spec.layers[-1].size
    if (*shape, classes) != (GRID, GRID, 10):
        raise UserError(
            f"{bundle.path}: made for {shape[0]}x{shape[1]} taxels and {classes} classes; the "
            f"page's skin has {GRID}x{GRID} taxels, for the ten digits"
        )


def about(bundle: Bundle, folder, outdated: str | None = None) -> dict:
    """The page's description of its network and of the folder of recordings.

    Parameters
    ----------
    bundle : Bundle
    folder : path-like
    outdated : str, optional
        Why the bundle is outdated, if it is.
    """
    return {
        "folder": str(folder),
        "architecture": bundle.spec.architecture,
        "outdated": outdated,
        "bundle": bundle.id[:12],
        "trained_on": bundle.spec.provenance.get("source", "recordings of unknown origin"),
        "simulated": bool(bundle.spec.provenance.get("simulated", False)),
    }
