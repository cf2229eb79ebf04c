# The live node and `boxreg`, with compiled kernels: docker build -t boxreg_ros .
# docs/tasks/run-on-a-robot.md has the arguments and what the image was tested with.
FROM ros:jazzy-ros-base
SHELL ["/bin/bash", "-c"]

# Kernels are loaded by the kind of CPU that they were compiled for. `generic` runs everywhere;
# name that of the robot for the fastest: --build-arg CPU=x86-64-v3
ARG CPU=generic
ARG TORCH=torch
ENV NUMBA_CPU_NAME=${CPU} NUMBA_CPU_FEATURES="" NUMBA_CACHE_DIR=/opt/boxreg/kernels
ENV PATH=/ws/.venv/bin:/ws/install/boxreg_ros/lib/boxreg_ros:${PATH}

WORKDIR /ws
COPY . src/boxreg_ros
RUN apt-get update \
    && apt-get install -y --no-install-recommends python3-colcon-common-extensions python3-rosdep python3-venv \
    && (rosdep init || true) && rosdep update \
    && rosdep install -y --from-paths src --ignore-src --dependency-types exec \
        --skip-keys "python3-numba python3-orjson python3-pytorch-pip python3-rosbags-pip" \
    && rm -rf /var/lib/apt/lists/*
RUN python3 -m venv --system-site-packages .venv && touch .venv/COLCON_IGNORE \
    && pip install --no-cache-dir "${TORCH}" mcap numba orjson rosbags
RUN source /opt/ros/jazzy/setup.bash && python3 -m colcon build --packages-select boxreg_ros
# Any user may run the image: numba needs a cache that it can write to.
RUN source install/setup.bash && boxreg compile && chmod -R a+rwX "${NUMBA_CACHE_DIR}"

ENTRYPOINT ["/bin/bash", "-c", "source /ws/install/setup.bash && exec \"$@\"", "boxreg"]
CMD ["ros2", "launch", "boxreg_ros", "boxreg.launch.xml"]
