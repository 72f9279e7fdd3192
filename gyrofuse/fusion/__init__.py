"""An array of gyros as one virtual gyro."""
