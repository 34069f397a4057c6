"""What goes wrong because of what a person wrote: one line each, naming key, value and what is allowed."""


class SceneError(ValueError):
    """A scene, or a shape, panel or STL that it names, cannot be used as written."""


class RecordError(ValueError):
    """A file of results is missing, damaged or would be overwritten."""
