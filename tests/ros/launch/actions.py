from .context import perform


class DeclareLaunchArgument:
    def __init__(self, name, *, default_value=None, description=None, choices=None):
        self._name, self._default_value = name, default_value

    def declare(self, context):
        if self._name not in context.launch_configurations:
            if self._default_value is None:
                raise RuntimeError(f'launch argument {self._name} has to be given')
            context.launch_configurations[self._name] = perform(context, self._default_value)


class ExecuteProcess:
    def __init__(self, *, cmd, name=None, output='log'):
        self._cmd = cmd

    def command(self, context):
        return [perform(context, word) for word in self._cmd]
