"""What substitutions are performed with."""


class LaunchContext:
    def __init__(self, arguments):
        self.launch_configurations = arguments


def perform(context, value):
    """A string, a substitution, or a list of both, as a string."""
    if isinstance(value, str):
        return value
    if isinstance(value, list):
        return ''.join(perform(context, part) for part in value)
    return value.perform(context)
