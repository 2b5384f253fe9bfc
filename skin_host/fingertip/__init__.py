"""Contact sensing that is not skin: force and torque, three-axis elements, slip.

The papers behind it, as the modules name them:

- Bicchi and Dario: "Intrinsic tactile sensing for artificial hands": contact from force and
  torque, six gauges on a cylinder, friction limits.
- Son et al.: "Comparison of contact sensor localization abilities during manipulation":
  an 8 x 8 array and three gauges on one planar fingertip.
- Ohka et al.: "Object-handling tasks based on active tactile and slippage sensations":
  41 three-axis elements on a dome, slip, flags of a grasping hand.
- The multi-axial study: "A study of multi-axial tactile sensors": two beams and three gauges
  with a small condition number.
"""
