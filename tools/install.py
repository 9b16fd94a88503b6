"""Installs requirements with uv, in the versions and with the hashes in constraints.txt.

uv takes a fraction of pip's time, but it does not read pip's settings. Mirrors, folders of wheels
and the timeout that are set for pip are passed on to uv.

    .venv/bin/python tools/install.py -e ".[dev]"
"""

import os
import subprocess
import sys
from collections.abc import Mapping

# pip's settings, and the environment variables with which uv reads the same settings
SETTINGS = {
    "index-url": "UV_DEFAULT_INDEX",
    "extra-index-url": "UV_INDEX",
    "find-links": "UV_FIND_LINKS",
    "default-timeout": "UV_HTTP_TIMEOUT",
}


def uv_environment(pip_settings: str, environment: Mapping[str, str]) -> dict[str, str]:
    """Returns the environment in which uv uses pip's settings.

    Args:
        pip_settings: output of `pip config list`, with lines such as `global.index-url='https://…'`.
            Later lines override earlier lines.
        environment: the current environment. Its variables for uv override pip's settings.
    """
    # Like pip, use the certificates of the system; like pip, take the newest version of all indexes.
    variables = {"UV_SYSTEM_CERTS": "1", "UV_INDEX_STRATEGY": "unsafe-best-match"}
    for line in pip_settings.splitlines():
        key, _, value = line.partition("=")
        if variable := SETTINGS.get(key.rpartition(".")[2]):
            variables[variable] = value.strip("'\"")
    return {**variables, **environment, "VIRTUAL_ENV": sys.prefix}


def main(requirements: list[str]) -> int:
    pip = subprocess.run(
        [sys.executable, "-m", "pip", "config", "list"], capture_output=True, text=True, check=True
    )
    install = [sys.executable, "-m", "uv", "pip", "install", "--quiet", "-c", "constraints.txt"]
    environment = uv_environment(pip.stdout, os.environ)
    return subprocess.run([*install, *requirements], env=environment, check=False).returncode


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
