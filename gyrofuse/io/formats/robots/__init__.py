"""Logs of robots: ROS bags, PX4 ULog, ArduPilot dataflash."""
