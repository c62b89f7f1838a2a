"""A run of any pipeline on real processes: driver, unit processes, worker, requests.

It may use `scheduler/`, `transport/` and what lies below; it knows neither scene nor avatar, OpenGL or ONNX.
"""
