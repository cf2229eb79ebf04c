"""Where uv gets packages from: as pip's settings say."""

from uv_install import variables

LISTED = [
    ":env:.find-links='/wheels\\n/more'", ":env:.cert='/own.crt'",
    "global.cert='/all.crt'", "global.extra-index-url='file:///a file:///b'",
    "global.index-url='file:///all'", "install.index-url='file:///install'",
    "global.timeout='60'",
]  # fmt: skip


def test_variables_of_uv_are_the_settings_of_pip_in_their_order():
    assert variables(LISTED) == {
        'UV_INDEX_STRATEGY': 'unsafe-best-match',
        'UV_FIND_LINKS': '/wheels,/more',
        'SSL_CERT_FILE': '/own.crt',
        'UV_EXTRA_INDEX_URL': 'file:///a file:///b',
        'UV_DEFAULT_INDEX': 'file:///install',
    }
    assert variables([]).keys() == {'UV_INDEX_STRATEGY'}
