"""The meaning of values in files: taxels, size of the sensor, unit of time, channels of counts."""
