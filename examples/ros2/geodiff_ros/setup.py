"""Package of the ROS 2 node, for colcon."""

from setuptools import setup

NAME = "geodiff_ros"

setup(
    name=NAME,
    version="0.1.0",
    packages=[NAME],
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
        (f"share/{NAME}/launch", ["launch/depth.launch.py"]),
        (f"share/{NAME}/config", ["config/depth.yaml"]),
    ],
    install_requires=["setuptools", "geodiff-plugin"],
    entry_points={"console_scripts": ["depth_node = geodiff_ros.node:main"]},
)
