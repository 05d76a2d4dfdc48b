"""Estimators over ONNX Runtime."""

import os

# from 1.29 on its wheels report every session to their maker, unless this is set before the first import
os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")
