"""The programs of SLURM and munge: found, or installed where that is a matter of two commands."""

import os
import shutil
import subprocess

PROGRAMS = ("slurmctld", "slurmd", "srun", "sbatch", "scontrol", "munged", "setpriv")
PACKAGES = ("slurm-wlm", "munge")
SEARCH_PATH = os.pathsep.join([os.environ.get("PATH", ""), "/usr/sbin", "/usr/local/sbin"])
"""Daemons are not in everybody's PATH."""
_APT = ("apt-get", "-o", "Acquire::Retries=2", "-o", "DPkg::Lock::Timeout=120")
_APT_SECONDS = 600


def find_missing() -> list[str]:
    """Name the programs that are not here."""
    return [name for name in PROGRAMS if shutil.which(name, path=SEARCH_PATH) is None]


def provide_programs() -> str:
    """Install SLURM and munge where they are absent, which takes root and apt.

    Returns:
        Nothing, or one line: what is missing and what to do.
    """
    missing = find_missing()
    if not missing:
        return ""
    found = f"no {', '.join(missing)} on this machine"
    wanted = f"install the packages {' and '.join(PACKAGES)}"
    if os.geteuid() != 0 or shutil.which("apt-get") is None:
        return f"{found}; {wanted}, or run as root on Debian, where this is done for you"
    error = _install()
    still = find_missing()
    if error or still:
        return f"{found}, and apt-get failed: {error or 'still no ' + ', '.join(still)}; {wanted}"
    return ""


def _install() -> str:
    """Run apt-get; give its first line of complaint, or nothing."""
    env = {**os.environ, "DEBIAN_FRONTEND": "noninteractive"}
    install = (*_APT, "install", "-y", "--no-install-recommends", *PACKAGES)
    for command in ((*_APT, "update"), install):
        try:
            done = subprocess.run(
                command, env=env, capture_output=True, text=True, timeout=_APT_SECONDS
            )
        except (OSError, subprocess.TimeoutExpired) as error:
            return str(error)
        if done.returncode:
            errors = [line for line in done.stderr.splitlines() if line.startswith("E: ")]
            return errors[0] if errors else f"exit code {done.returncode}"
    return ""
