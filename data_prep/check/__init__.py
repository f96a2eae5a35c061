"""Do the shards hold what they claim? Measured on the stored pixels, not taken from the meta.

Every quantity looks at geometry alone, so the verdict does not depend on which mistake was made:
a principal point half a pixel off, camera axes of another convention, inverted cameras and ranges
in place of depth all leave the two views of a pair in disagreement. Files, checksums and members
that are broken are collected, named and counted.
"""

from data_prep.check.limits import EXACT, LIMITS, NOISY, OWN, Limits
from data_prep.check.report import CheckReport
from data_prep.check.run import CheckOptions, check_shards
from data_prep.check.tars import find_folders

__all__ = [
    "EXACT",
    "LIMITS",
    "NOISY",
    "OWN",
    "CheckOptions",
    "CheckReport",
    "Limits",
    "check_shards",
    "find_folders",
]
