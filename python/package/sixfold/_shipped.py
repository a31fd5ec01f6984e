"""Finds the weights and samples shipped with Sixfold, in the search order of the program (docs/install.md)."""

import os
from pathlib import Path

#: Path of each item in a checkout, and the file that identifies a folder ("" if the item is a file).
_KNOWN = {
    "demo": ("data/demo", "test_targets_bop19.json"),
    "weights/pix2pose-lmo.safetensors": ("weights/pix2pose-lmo.safetensors", ""),
    "weights/detector-lmo.safetensors": ("weights/detector-lmo.safetensors", ""),
    "weights/dgcm.safetensors": ("weights/dgcm.safetensors", ""),
}


def _candidates(name, checkout):
    variable = os.environ.get("SIXFOLD_SHARE")
    if variable:
        return [Path(variable, name), Path(variable, checkout)]
    here = Path.cwd()
    absolute = [Path(os.environ.get("XDG_DATA_HOME", "")), Path(os.environ.get("HOME", ""), ".local/share")]
    user = [folder / "sixfold" / name for folder in absolute if folder.is_absolute()][:1]
    own = Path(__file__).resolve().parent / "share" / name
    return [*(folder / checkout for folder in (here, *here.parents)), own, *user]


def shipped(name):
    """Returns the path of an item shipped with Sixfold: the sample frames of LM-O, or a weight file.

    If the environment variable ``SIXFOLD_SHARE`` is set, only the folder that it names is searched. Otherwise the
    search order is:

    1. a checkout of the repository in the current folder or in a folder above it;
    2. this package;
    3. ``sixfold`` in the user's data folder (``$XDG_DATA_HOME`` if it is an absolute path, else ``~/.local/share``).

    Args:
        name: ``"demo"``, ``"weights/pix2pose-lmo.safetensors"``, ``"weights/detector-lmo.safetensors"`` or
            ``"weights/dgcm.safetensors"``.

    Returns:
        An absolute path.

    Raises:
        ValueError: no item with this name is shipped with Sixfold.
        FileNotFoundError: it was not found. The message lists the places that were searched.

    >>> dataset = sixfold.bop.Dataset(sixfold.shipped("demo"))  # doctest: +SKIP
    """
    if name not in _KNOWN:
        raise ValueError(f"name: expected one of {', '.join(map(repr, _KNOWN))}, found {name!r}")
    checkout, sign = _KNOWN[name]
    candidates = list(dict.fromkeys(_candidates(name, checkout)))
    for path in candidates:
        if (path / sign).is_file():
            return path.resolve()
    raise FileNotFoundError(
        f"{name} is in none of these places: {', '.join(map(str, candidates))}. Let the environment variable SIXFOLD_SHARE "
        "name a folder that has it (docs/install.md)"
    )
