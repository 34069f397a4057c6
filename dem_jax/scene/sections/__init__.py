"""The sections of a scene, by subject."""
