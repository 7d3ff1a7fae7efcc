"""A ROS domain for this process alone: two test runs, or two workers of one, never hear each other's nodes."""

from __future__ import annotations

import fcntl
import getpass
import os
import tempfile
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import IO

DOMAINS = range(1, 102)  # beyond, the ports of DDS meet those that Linux gives to other programs
FIRST_PORT, PORTS = 7400, 250  # of domain 0, and from one domain to the next
_held: list[IO[str]] = []


@cache
def claim() -> int:
    """A domain that nobody on this machine uses; its lock is held until this process ends.

    Raises:
        RuntimeError: all are taken.
    """
    folder = Path(tempfile.gettempdir()) / f"gapr_ros_domains_{getpass.getuser()}"
    folder.mkdir(exist_ok=True)
    busy = set(_domains_of_open_ports())
    first = os.getpid() % len(DOMAINS)
    for domain in (*DOMAINS[first:], *DOMAINS[:first]):
        if domain not in busy and _lock(folder / str(domain)):
            os.environ["ROS_DOMAIN_ID"] = str(domain)
            os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
            return domain
    raise RuntimeError(f"expected a free ROS domain of {len(DOMAINS)}; got none: end the nodes that were left running")


def _lock(path: Path) -> bool:
    file = path.open("w")
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        file.close()
        return False
    _held.append(file)
    return True


def _domains_of_open_ports() -> Iterator[int]:
    """Domains in which some process of this machine, of whatever origin, listens by UDP."""
    for table in (Path("/proc/net/udp"), Path("/proc/net/udp6")):
        for line in table.read_text().splitlines()[1:] if table.exists() else ():
            port = int(line.split()[1].rsplit(":", 1)[1], 16)
            yield (port - FIRST_PORT) // PORTS
