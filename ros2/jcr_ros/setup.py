"""Package of the ROS 2 node."""

from setuptools import setup

NAME = "jcr_ros"

setup(
    name=NAME,
    version="0.4.0",
    packages=[NAME],
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
        (f"share/{NAME}/launch", ["launch/calibrate.launch.py"]),
        (f"share/{NAME}/rviz", ["rviz/calibrate.rviz"]),
    ],
    install_requires=["setuptools", "jcr-handeye"],
    zip_safe=True,
    license="Apache-2.0",
    entry_points={"console_scripts": ["calibrate = jcr_ros.node:main"]},
)
