"""
Runs a bridge: ingress, an egress for each lane of the configuration, and control.

    ros2 launch adaptive_bridge adaptive_bridge.launch.py config_path:=/path/to/my.yaml

`adaptive-bridge up` starts these processes and starts again those that die. launch's own `respawn` would also try
again, without an end, what a bad configuration or a wrong command line has ended.
"""

from pathlib import Path

from ament_index_python.packages import get_package_prefix
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, ExecuteProcess
from launch.substitutions import EnvironmentVariable, LaunchConfiguration


def generate_launch_description():
    prefix = Path(get_package_prefix('adaptive_bridge'))
    program = prefix / 'lib' / 'adaptive_bridge' / 'adaptive-bridge'
    example = prefix / 'share' / 'adaptive_bridge' / 'config' / 'minimal.yaml'
    return LaunchDescription([
        DeclareLaunchArgument(
            'config_path',
            default_value=EnvironmentVariable('ADAPTIVE_BRIDGE_CONFIG', default_value=str(example)),
            description='Configuration file. The example bridges /scan.',
        ),
        # Not a Node, which would name one node: the bridge has several.
        ExecuteProcess(
            cmd=[str(program), 'up', '--config', LaunchConfiguration('config_path')],
            name='adaptive_bridge',
            output='screen',
        ),
    ])
