"""All mathematics as pure, differentiable, compilable functions of tensors."""
