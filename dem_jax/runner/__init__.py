"""The host loop: runs a scene chunk by chunk and reports every failure."""
