"""Installs the node where ROS 2 looks for it; `skin-host` itself comes from pip."""

from setuptools import setup

NAME = "skin_host_ros"
setup(
    name=NAME,
    version="0.1.0",
    packages=[NAME],
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
        (f"share/{NAME}/launch", ["launch/skin.launch.py"]),
    ],
    install_requires=["setuptools", "skin-host"],
    entry_points={"console_scripts": [f"skin = {NAME}.node:main"]},
)
