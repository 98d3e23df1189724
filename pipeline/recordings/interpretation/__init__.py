"""What the values in files mean: taxels, size of the sensor, unit of time, channels of counts."""
