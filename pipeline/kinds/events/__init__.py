"""Spiking networks that are trained on the events of the sensor."""
