"""OpenVINO without its telemetry. Rule: Trilane imports it from here, and nothing that it does leaves the machine.

Imported by itself it tells a server of its maker that it was imported, and keeps a number for that in the home folder;
without the package `openvino_telemetry` it uses a stand-in of its own, which does neither.
"""

import sys
from typing import Any, cast

cast(dict[str, Any], sys.modules).setdefault("openvino_telemetry", None)

import openvino  # noqa: E402

__all__ = ["openvino"]
