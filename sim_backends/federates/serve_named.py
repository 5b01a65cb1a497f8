"""Serves a named federate that is a Python class.

The command is, for example, `python -m sim_backends.federates.serve_named physics mujoco [ADDRESS]`.
"""

import sys

from sim_backends.federates.frames import ROLES
from sim_backends.federates.named import PythonFederate, named_federate
from sim_backends.federates.serving import serve_service


def main(role_name: str, name: str, address: str | None = None) -> None:
    """Serve a federate.

    Args:
        role_name: `physics` or `network`.
        name: Name of the federate.
        address: Address of a transport; None for standard input and output.

    Raises:
        SystemExit: There is no federate with this name that is a Python class, or `serve_service` raised it.
    """
    (role,) = (number for number, text in ROLES.items() if text == role_name)
    federate = named_federate(name, role)
    if not isinstance(federate, PythonFederate):
        raise SystemExit(f"{name} is not a Python class")
    serve_service(federate.load(), address=address)


if __name__ == "__main__":
    main(*sys.argv[1:])
