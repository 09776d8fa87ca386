import os

from .context import perform


class LaunchConfiguration:
    def __init__(self, variable_name):
        self._name = variable_name

    def perform(self, context):
        return context.launch_configurations[perform(context, self._name)]


class EnvironmentVariable:
    def __init__(self, name, *, default_value=None):
        self._name, self._default_value = name, default_value

    def perform(self, context):
        value = os.environ.get(perform(context, self._name))
        return perform(context, self._default_value) if value is None else value
