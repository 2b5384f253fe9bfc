"""Fingertips on force/torque boards: wrench, contact point, slip and the grasp's events.

Bicchi and Dario, "Intrinsic tactile sensing for artificial hands", for the contact from force and
torque; Ohka et al., "Object-handling tasks based on active tactile and slippage sensations", for
slip and the flags of a grasping hand.
"""
