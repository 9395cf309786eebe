"""Checks of a calibration, each of which adds its findings: capture, camera, robot, boards, lengths, poses."""
