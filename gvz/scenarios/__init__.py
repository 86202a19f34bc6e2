"""Scenarios: one file each, discovered by its SCENARIO; the compiler that makes maps of them."""
