from setuptools import setup

setup(
    name="steadypose_ros",
    version="0.1.0",
    packages=["steadypose_ros"],
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/steadypose_ros"]),
        ("share/steadypose_ros", ["package.xml"]),
        ("share/steadypose_ros/config", ["config/steadypose.yaml"]),
        ("share/steadypose_ros/launch", ["launch/steadypose.launch.py"]),
    ],
    install_requires=["setuptools"],
    zip_safe=True,
    maintainer="steadypose",
    maintainer_email="steadypose@users.noreply.github.com",
    description="Starts steadypose as a lifecycle node",
    license="Apache-2.0",
    entry_points={"console_scripts": ["steadypose = steadypose_ros.node:main"]},
)
