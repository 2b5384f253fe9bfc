"""Reproductions of the papers on contact sensing that no robot runs; see `skin report --contacts`.

- Bicchi and Dario: "Intrinsic tactile sensing for artificial hands": contact from force and
  torque, gauges on a cylinder (`force_torque`), friction limits.
- Son et al.: "Comparison of contact sensor localization abilities during manipulation":
  an 8 x 8 array and three gauges on one fingertip, and their fusion (`fusion`).
- Ohka et al.: "Object-handling tasks based on active tactile and slippage sensations":
  41 three-axis elements on a dome, and the hand that grasps with them (`grasp_loops`).
- "A study of multi-axial tactile sensors": two beams and three gauges (`force_torque`).

`truth` has the emulated fingertips that the methods are measured against.
"""
