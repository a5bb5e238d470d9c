"""Released networks: ONNX files with their cards."""
