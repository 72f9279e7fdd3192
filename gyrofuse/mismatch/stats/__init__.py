"""Statistical kernels: tensors in, numbers out. They know no recording, simulation or mechanism."""
