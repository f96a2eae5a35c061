"""At most one process works on a run."""

import fcntl
import os
from contextlib import suppress
from pathlib import Path


class RunLock:
    """A lock on a run's folder that ends with the last process that holds it, however that ends.

    On a file system without locks it holds nothing and hinders nobody.

    Args:
        folder: The run's; made where absent.
    """

    def __init__(self, folder: Path) -> None:
        self.path = folder / ".lock"
        self.descriptors: tuple[int, ...] = ()

    def acquire(self) -> bool:
        """Take the lock; False where another process has it."""
        self.path.parent.mkdir(parents=True, exist_ok=True)
        descriptor = os.open(self.path, os.O_RDWR | os.O_CREAT, 0o644)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            os.close(descriptor)
            return False
        except OSError:
            os.close(descriptor)
            return True
        self.descriptors = (descriptor,)
        return True

    def release(self) -> None:
        """Give it back; processes that have inherited it keep it."""
        for descriptor in self.descriptors:
            with suppress(OSError):
                os.close(descriptor)
        self.descriptors = ()
