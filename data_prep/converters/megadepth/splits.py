"""Which scenes of MegaDepth are trained on, which are held out, and why others are left out."""

from typing import Literal

Split = Literal["train", "test", "all"]

HELD_OUT = frozenset({"0015", "0022"})
"""Scenes of the MegaDepth-1500 test pairs, which DUSt3R validates on as well."""

IMAGE_MATCHING = frozenset({"0008", "0019", "0021", "0024", "0025", "0032", "0063", "1589"})
"""Scenes of the Image Matching Challenge's test set."""

TANKS_AND_TEMPLES = 5000
"""Scenes numbered from here on hold Tanks and Temples."""

_CLEAN = """
0001 0003 0004 0005 0007 0012 0013 0016 0017 0023 0026 0027 0034 0035 0036 0037 0039 0041
0042 0043 0044 0046 0047 0048 0049 0056 0057 0058 0060 0061 0062 0064 0065 0067 0070 0071
0076 0078 0080 0083 0086 0087 0090 0094 0095 0098 0099 0100 0101 0102 0104 0107 0115 0117
0122 0129 0130 0137 0141 0147 0148 0149 0150 0151 0156 0160 0162 0175 0181 0183 0185 0186
0189 0190 0197 0200 0204 0205 0212 0214 0217 0223 0224 0231 0235 0237 0238 0240 0243 0252
0257 0258 0269 0271 0275 0277 0281 0285 0286 0290 0294 0299 0303 0306 0307 0312 0323 0326
0327 0331 0335 0341 0348 0360 0377 0380 0387 0389 0394 0402 0406 0407 0411 0446 0455 0472
0476 0478 0482 0493 0496 0505 0559 0733 0768 1017 3346
"""
CLEAN = frozenset(_CLEAN.split())
"""Training scenes of DISK, LoFTR and glue-factory below 5000, which share no landmark with the
Image Matching Challenge."""


def excluded_because(scene_id: str) -> str:
    """Say why a scene is neither trained nor tested on by default; empty where it is.

    Args:
        scene_id: Four digits. Any other name is no scene of MegaDepth, and never excluded.
    """
    if not (len(scene_id) == 4 and scene_id.isdecimal()):
        return ""
    if int(scene_id) >= TANKS_AND_TEMPLES:
        return "holds a scene of Tanks and Temples, an evaluation set"
    if scene_id in IMAGE_MATCHING:
        return "holds a test scene of the Image Matching Challenge"
    if scene_id in CLEAN or scene_id in HELD_OUT:
        return ""
    return "not in the cleaned training list: it may show a landmark of a test set"


def is_in(scene_id: str, split: Split) -> bool:
    """Tell whether a scene belongs to a split; what is not held out is trained on."""
    return split == "all" or (scene_id in HELD_OUT) == (split == "test")
