"""How many threads the arithmetic takes."""


def use_one_thread() -> None:
    """Compute in one thread.

    The work is thousands of operations of a millisecond. Threads that meet after each gain little
    on a free machine, and on a shared one they wait for each other: seven minutes instead of one.
    """
    import torch

    torch.set_num_threads(1)
