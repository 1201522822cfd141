"""Keys of the processes that a run starts for itself.

Who can reach a scheduler of Dask can run code as its user; on a machine of many users,
those are all of them. Our processes speak TLS, and accept only who has their keys.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from distributed.security import Security

_COMM = "DASK_DISTRIBUTED__COMM__"


def secrets_of(security: Security) -> dict[str, str]:
    """Keys and certificates as environment variables that Dask reads, and no pages.

    Command lines are seen by all users of a machine, environments by their own only;
    and on the disk there is no key.
    """
    found = {
        f"{_COMM}REQUIRE_ENCRYPTION": "True",
        f"{_COMM}TLS__CA_FILE": _of(security, "ca_file"),
    }
    for role in ("client", "scheduler", "worker"):
        for what in ("key", "cert"):
            variable = f"{_COMM}TLS__{role}__{what}".upper()
            found[variable] = _of(security, f"{role}_{what}")
    for role in ("SCHEDULER", "WORKER"):
        found[f"DASK_DISTRIBUTED__{role}__HTTP__ROUTES"] = "[]"
    return found


def _of(security: Security, name: str) -> str:
    """A text of `Security.temporary`, whose attributes are made at run time."""
    return str(getattr(security, f"tls_{name}"))
