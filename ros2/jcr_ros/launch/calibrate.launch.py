"""Launch the node, and RViz with robot, frames and camera."""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare

TEXT = {
    "folder": "jcr_capture",
    "base_frame": "base_link",
    "gripper_frame": "tool0",
    "camera_frame": "camera_color_optical_frame",
    "image_topic": "/camera/color/image_raw",
    "camera_info_topic": "/camera/color/camera_info",
    "depth_topic": "",
    "robot": "",
}


def generate_launch_description() -> LaunchDescription:
    """Return the node with its parameters as launch arguments, and RViz."""
    arguments = [DeclareLaunchArgument(name, default_value=value) for name, value in TEXT.items()]
    arguments += [
        DeclareLaunchArgument("images", default_value="0"),
        DeclareLaunchArgument("require_mm", default_value="5.0"),
        DeclareLaunchArgument("require_deg", default_value="1.0"),
        DeclareLaunchArgument("until_accurate", default_value="false"),
        DeclareLaunchArgument("at_rest", default_value="true"),
        DeclareLaunchArgument("rviz", default_value="true"),
    ]
    parameters = {name: ParameterValue(LaunchConfiguration(name), value_type=str) for name in TEXT}
    parameters["images"] = ParameterValue(LaunchConfiguration("images"), value_type=int)
    for name in ("require_mm", "require_deg"):
        parameters[name] = ParameterValue(LaunchConfiguration(name), value_type=float)
    parameters["until_accurate"] = ParameterValue(LaunchConfiguration("until_accurate"), value_type=bool)
    parameters["at_rest"] = ParameterValue(LaunchConfiguration("at_rest"), value_type=bool)
    view = PathJoinSubstitution([FindPackageShare("jcr_ros"), "rviz", "calibrate.rviz"])
    return LaunchDescription(
        [
            *arguments,
            Node(
                package="jcr_ros",
                executable="calibrate",
                name="jcr",
                output="screen",
                parameters=[parameters],
            ),
            Node(
                package="rviz2",
                executable="rviz2",
                arguments=["-d", view, "-f", LaunchConfiguration("base_frame")],
                condition=IfCondition(LaunchConfiguration("rviz")),
            ),
        ]
    )
