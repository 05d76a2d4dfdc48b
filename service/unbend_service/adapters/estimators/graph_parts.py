"""An ONNX network in two parts: what can be computed before some of its inputs are known, or the module that it begins
with; and the rest.

ONNX Runtime runs a network as a whole. Only the few fields of the format (``onnx.proto``, IR version 3 and later) that
say how nodes hang together are read; protobuf carries everything else over as it is.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

from google.protobuf.descriptor_pb2 import FieldDescriptorProto, FileDescriptorProto
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.message import DecodeError
from google.protobuf.message_factory import GetMessageClass

#: Nodes with graphs of their own, which see names of the outer one without saying so.
_NESTED = frozenset({"If", "Loop", "Scan", "SequenceMap"})
_FLOAT = 1
_FIELDS: dict[str, dict[str, tuple[int, str, bool]]] = {
    "Node": {"input": (1, "", True), "output": (2, "", True), "name": (3, "", False), "op_type": (4, "", False)},
    "Tensor": {"name": (8, "", False)},
    "TensorType": {"elem_type": (1, "int", False)},
    "Type": {"tensor_type": (1, "TensorType", False)},
    "Value": {"name": (1, "", False), "type": (2, "Type", False)},
    "Graph": {
        "node": (1, "Node", True),
        "initializer": (5, "Tensor", True),
        "input": (11, "Value", True),
        "output": (12, "Value", True),
    },
    "Model": {"graph": (7, "Graph", False)},
}
"""Message -> field -> number, message (or ``int``, or nothing for a string), whether it repeats."""


@dataclass(frozen=True, slots=True)
class Parts:
    """Two networks that are one.

    Attributes:
        early, late: serialised.
        between: float tensors that the first gives and the second takes, beside the inputs that both have by name.
    """

    early: bytes
    late: bytes
    between: tuple[str, ...]


def parted(network: bytes, awaited: Collection[str]) -> Parts | None:
    """Splits a network; None where it cannot be read, or nothing can be computed early.

    Args:
        network: a serialised ``ModelProto`` with its weights inside.
        awaited: inputs that are known late.
    """
    waiting = set(awaited)

    def early(node: Any) -> bool:
        if waiting.isdisjoint(node.input):
            return True
        waiting.update(node.output)
        return False

    return _split(network, early)


def headed(network: bytes, module: str) -> Parts | None:
    """Splits off the module that a network begins with; None where it begins with none of that name.

    Args:
        network: a serialised ``ModelProto`` with its weights inside.
        module: what the names of the module's nodes begin with, as exporting gave them.
    """
    return _split(network, lambda node: node.name.startswith(module))


def _split(network: bytes, is_early: Callable[[Any], bool]) -> Parts | None:
    """None where it cannot be read, or where the first part would have nothing to go by or nothing to give."""
    try:
        whole = _model().FromString(network)
    except DecodeError:
        return None
    nodes = list(whole.graph.node)
    if any(node.op_type in _NESTED for node in nodes):
        return None
    constants = [node for node in nodes if node.op_type == "Constant"]
    begun: list[Any] = []
    late: list[Any] = []
    for node in nodes:  # in topological order, as the format demands
        if node.op_type != "Constant":
            (begun if is_early(node) else late).append(node)
    given = {name for node in begun for name in node.output}
    between = tuple(sorted({name for node in late for name in node.input} & given))
    seen = {name for node in begun for name in node.input} & {value.name for value in whole.graph.input}
    if not (between and seen and given.isdisjoint(value.name for value in whole.graph.output)):
        return None
    return Parts(
        _network(whole, begun, constants, gives=between),
        _network(whole, late, constants, takes=between),
        between,
    )


def _network(
    whole: Any, nodes: list[Any], constants: list[Any], *, takes: Sequence[str] = (), gives: Sequence[str] = ()
) -> bytes:
    """A network of some nodes of the whole one, with the constants and weights that they use.

    It takes tensors ``takes`` beside inputs of the whole, and gives tensors ``gives``, or what the whole does.
    """
    part = _model()()
    part.CopyFrom(whole)
    graph = part.graph
    for field in ("node", "initializer", "input"):
        graph.ClearField(field)
    used = {name for node in nodes for name in node.input}
    kept = [node for node in constants if not used.isdisjoint(node.output)]
    graph.node.extend([*kept, *nodes])
    graph.initializer.extend(tensor for tensor in whole.graph.initializer if tensor.name in used)
    graph.input.extend(value for value in whole.graph.input if value.name in used)
    if gives:
        graph.ClearField("output")
    for values, names in ((graph.input, takes), (graph.output, gives)):
        for name in names:
            value = values.add(name=name)
            value.type.tensor_type.elem_type = _FLOAT
    return bytes(part.SerializeToString())


@cache
def _model() -> Any:
    """The class of ``ModelProto`` as far as it is read here."""
    described = FileDescriptorProto(name="unbend/network.proto", package="unbend.network", syntax="proto2")
    for name, fields in _FIELDS.items():
        message = described.message_type.add(name=name)
        for field_name, (number, kind, repeats) in fields.items():
            field = message.field.add(name=field_name, number=number)
            field.label = FieldDescriptorProto.LABEL_REPEATED if repeats else FieldDescriptorProto.LABEL_OPTIONAL
            if kind in ("", "int"):
                field.type = FieldDescriptorProto.TYPE_INT32 if kind else FieldDescriptorProto.TYPE_STRING
            else:
                field.type, field.type_name = FieldDescriptorProto.TYPE_MESSAGE, f".unbend.network.{kind}"
    pool = DescriptorPool()
    pool.Add(described)
    return GetMessageClass(pool.FindMessageTypeByName("unbend.network.Model"))
