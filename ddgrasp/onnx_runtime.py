"""onnxruntime, which is told before it is imported that nobody wants its telemetry.

Official builds since 1.29 write a device's id and what is run (files' names, hashes of graphs, times) under
`~/.cache/Microsoft` and send it to Microsoft, unless this variable is set. A robot's policies are nobody
else's business; who wants to tell sets it to 0.
"""

import os

os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")

import onnxruntime as ort  # noqa: E402

__all__ = ["ort"]
