"""
A stand-in for `launch` of ROS 2, which no package registry but ROS' own has: what this project's launch file uses,
with the names, arguments and meaning that it has there, and nothing else. What it lacks fails.
"""

import signal
import subprocess

from . import actions
from .context import LaunchContext


class LaunchDescription:
    def __init__(self, initial_entities=None):
        self.entities = list(initial_entities or [])


class LaunchService:
    """Runs descriptions until their processes have ended; passes SIGINT on, as that of ROS 2 does."""

    def __init__(self, *, argv=None):
        self._context = LaunchContext(dict(argument.split(':=', 1) for argument in argv or []))
        self._processes = []

    def include_launch_description(self, description):
        for entity in description.entities:
            if isinstance(entity, actions.DeclareLaunchArgument):
                entity.declare(self._context)
            elif isinstance(entity, actions.ExecuteProcess):
                self._processes.append(entity.command(self._context))
            else:
                raise TypeError(f'{entity!r} is nothing that this stand-in knows')

    def run(self):
        running = [subprocess.Popen(command) for command in self._processes]
        signal.signal(signal.SIGINT, lambda *_: [process.send_signal(signal.SIGINT) for process in running])
        return max(process.wait() for process in running)
