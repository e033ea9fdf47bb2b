"""Tests of the thermostats."""
