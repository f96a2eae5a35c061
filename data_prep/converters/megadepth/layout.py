"""Where MegaDepth's parts lie: the two archives unpacked into one folder, or side by side."""

import re
from dataclasses import dataclass
from pathlib import Path

from data_prep.converters.colmap_model import find_ending

BASES = (
    "",
    "MegaDepth_v1",
    "phoenix/S6/zl548/MegaDepth_v1",
    "MegaDepth_v1_SfM",
    "MegaDepth_SfM_v1",
)
"""Folders that the archives unpack into, below the root."""

_DENSE = re.compile(r"dense(\d{1,4})")


@dataclass(frozen=True, kw_only=True)
class DensePart:
    """One reconstruction of a scene; two of the same scene share no frame."""

    name: str
    """``0001/dense0``."""
    folder: Path
    """Holds ``imgs`` and ``depths``."""
    model: Path | None
    """Its SfM model, if that is there."""

    @property
    def scene_id(self) -> str:
        """``0001``."""
        return self.name.partition("/")[0]


def find_parts(root: Path) -> list[DensePart]:
    """Find reconstructions with images and depth, sorted by name.

    Args:
        root: Folder that holds the scenes, or the unpacked archives.
    """
    dense: dict[str, Path] = {}
    models: dict[str, Path] = {}
    for base in (root / name for name in BASES):
        for scene in sorted(base.iterdir()) if base.is_dir() else []:
            if not scene.is_dir() or scene.name.startswith("."):
                continue
            for part in scene.glob("dense*"):
                if _DENSE.fullmatch(part.name) and (part / "imgs").is_dir():
                    dense.setdefault(f"{scene.name}/{part.name}", part)
            for model in (scene / "sparse" / "manhattan").glob("*"):
                if find_ending(model):
                    models.setdefault(f"{scene.name}/dense{model.name}", model)
    return [
        DensePart(name=name, folder=folder, model=models.get(name))
        for name, folder in sorted(dense.items())
    ]


def find_scene_infos(root: Path) -> list[Path]:
    """Find scene indices of D2-Net's and LoFTR's form, three folders deep at most."""
    return sorted(path for depth in ("*", "*/*", "*/*/*") for path in root.glob(f"{depth}.npz"))
