"""ONNX graphs, written operator by operator.  constants, nodes -> a checked model."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from torch import Tensor, nn

from workbench.extras import require

OPSET = 20


@dataclass
class Graph:
    """Nodes and constants of a graph that is being written."""

    nodes: list[Any] = field(default_factory=list)
    constants: list[Any] = field(default_factory=list)

    def constant(self, name: str, value: Tensor | np.ndarray) -> str:
        onnx: Any = require("onnx", extra="runtime")
        array = value.detach().numpy() if isinstance(value, Tensor) else value
        self.constants.append(onnx.numpy_helper.from_array(np.array(array, order="C"), name))
        return name

    def node(self, operator: str, inputs: list[str], outputs: list[str], **attributes: Any) -> str:
        onnx: Any = require("onnx", extra="runtime")
        self.nodes.append(onnx.helper.make_node(operator, inputs, outputs, **attributes))
        return outputs[0]

    def dense(self, name: str, layer: nn.Linear, source: str) -> str:
        weight, bias = self.constant(f"{name}.weight", layer.weight), self.constant(f"{name}.bias", layer.bias)
        return self.node("Gemm", [source, weight, bias], [name], transB=1)

    def model(self, name: str, inputs: dict[str, list[int]], outputs: dict[str, list[int]]) -> Any:
        onnx: Any = require("onnx", extra="runtime")

        def declared(shapes: dict[str, list[int]]) -> list[Any]:
            kind = onnx.TensorProto.FLOAT
            return [onnx.helper.make_tensor_value_info(key, kind, shape) for key, shape in shapes.items()]

        graph = onnx.helper.make_graph(self.nodes, name, declared(inputs), declared(outputs), self.constants)
        opsets = [onnx.helper.make_opsetid("", OPSET)]
        model = onnx.helper.make_model(graph, opset_imports=opsets, ir_version=10, producer_name="garment-workbench")
        onnx.checker.check_model(model)
        return model
