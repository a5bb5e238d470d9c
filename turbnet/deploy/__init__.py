"""Trained networks at work: ONNX, tiling, streaming. Never imports lightning."""
