"""Function room: all mathematics as pure, differentiable, compilable functions of tensors."""
