"""ONNX Runtime sessions on the CPU, with the threads that the settings grant and no more."""

from __future__ import annotations

from pathlib import Path

import onnxruntime as ort

from unbend_service.adapters.cores import usable_cores
from unbend_service.domain.errors import ModelUnavailable


def open_session(weights: Path, threads: int, part: bytes | None = None) -> ort.InferenceSession:
    """A session whose ``run`` may be called from several threads at once.

    Left to itself ONNX Runtime takes every core of the host and spins between calls, at the cost of the renderers.

    Args:
        weights: the ``.onnx`` file.
        part: of the network in that file, serialised, which is opened instead of the whole.
        threads: that one call uses, the caller's own among them; 0: as many as usable cores.

    Raises:
        ModelUnavailable: the file is no model that this runtime reads.
    """
    options = ort.SessionOptions()
    options.intra_op_num_threads = threads or usable_cores()
    options.inter_op_num_threads = 1
    options.execution_mode = ort.ExecutionMode.ORT_SEQUENTIAL
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    options.add_session_config_entry("session.inter_op.allow_spinning", "0")
    options.log_severity_level = 3  # its warnings concern the exporter, and would bypass the log
    try:
        return ort.InferenceSession(part or str(weights), options, providers=["CPUExecutionProvider"])
    except Exception as error:  # the runtime's errors share no base class but Exception
        raise ModelUnavailable(f"The weights {weights.name!r} cannot be loaded: {error}.", setting="model") from error
