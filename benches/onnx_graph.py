"""ONNX graphs over the tensors of a weight file, for the comparisons with ONNX Runtime."""

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper


class Graph:
    """Nodes of an ONNX graph over the tensors of a weight file (safetensors, opened with "np")."""

    def __init__(self, weights):
        self.weights, self.nodes, self.tensors, self.count = weights, [], [], 0

    def tensor(self, name):
        return self.weights.get_tensor(name).astype(np.float32)

    def node(self, kind, inputs, **attributes):
        self.count += 1
        name = f"{kind}_{self.count}"
        self.nodes.append(helper.make_node(kind, inputs, [name], **attributes))
        return name

    def constant(self, value):
        self.count += 1
        name = f"constant_{self.count}"
        self.tensors.append(numpy_helper.from_array(value, name))
        return name

    def model(self, shape, outputs):
        """The checked model from "image" of that shape to the outputs, whose shapes are left open."""
        ends = [helper.make_tensor_value_info(name, TensorProto.FLOAT, [None] * 4) for name in outputs]
        image = helper.make_tensor_value_info("image", TensorProto.FLOAT, shape)
        graph = helper.make_graph(self.nodes, "network", [image], ends, self.tensors)
        model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)])
        model.ir_version = 8
        onnx.checker.check_model(model)
        return model
