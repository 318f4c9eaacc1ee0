"""Files that the server sends and withholds."""

import hashlib
import http.client
import json
import shutil
import signal
import socket
import subprocess
import sys
import time
import zipfile
from contextlib import suppress
from functools import partial
from pathlib import Path
from urllib.parse import urlsplit

import pytest

from bitymi_ns.bundle import BundleError, check_files
from bitymi_ns.bundle.notes import notes_of
from bitymi_ns.bundle.single import write_single
from bitymi_ns.cli import main
from bitymi_ns.view import PageError, is_loopback, serve, single_site, site_of, write_static
from tests.bundle.damage import amend
from tests.bundle.test_notes import NOTES, text
from tests.view.browser import running, served


def ask(address: str, path: str, method: str = "GET", host: str | None = None) -> tuple[int, dict[str, str], bytes]:
    parts = urlsplit(address)
    connection = http.client.HTTPConnection(parts.hostname, parts.port, timeout=20)
    connection.putrequest(method, path, skip_host=True)
    connection.putheader("Host", host or parts.netloc)
    connection.endheaders()
    answer = connection.getresponse()
    body = answer.read()
    connection.close()
    return answer.status, dict(answer.getheaders()), body


def test_the_page_and_the_bundle_are_sent_with_their_types_and_a_policy(bundle: Path) -> None:
    with served(site_of(bundle)) as address:
        for path, kind in {
            "/": "text/html; charset=utf-8",
            "/index.js": "text/javascript; charset=utf-8",
            "/index.css": "text/css; charset=utf-8",
            "/bundle/bundle.json": "application/json",
            "/bundle/surfels.ply": "application/octet-stream",
            "/bundle/atlas.ktx2": "image/ktx2",
            "/bundle/photograph-0001.jpg": "image/jpeg",
        }.items():
            status, headers, body = ask(address, path)
            assert (status, headers["Content-Type"]) == (200, kind), path
            assert "default-src 'none'" in headers["Content-Security-Policy"]
            assert headers["X-Content-Type-Options"] == "nosniff" and len(body) == int(headers["Content-Length"])
        assert ask(address, "/bundle/surfels.ply")[2] == (bundle / "surfels.ply").read_bytes()
        status, headers, body = ask(address, "/", "HEAD")
        assert status == 200 and not body and int(headers["Content-Length"]) > 0
        assert json.loads(ask(address, "/view.json")[2]) == {"title": "little", "notes": False}


@pytest.mark.parametrize(
    "path",
    [
        *(
            "/bundle/../../../../etc/passwd",
            "/..%2f..%2fetc/passwd",
            "/bundle/%2e%2e/%2e%2e/etc/passwd",
            "//etc/passwd",
        ),
        *("/bundle/config.yml", "/bundle/", "/bundle", "/nothing", "/bundle/surfels.ply%00.js", "/serve.py", "*"),
    ],
)
def test_nothing_else_is_found(bundle: Path, path: str) -> None:
    (bundle / "config.yml").write_text("secret: 1\n")
    with served(site_of(bundle)) as address:
        status, headers, body = ask(address, path)
        assert status == 404 and b"secret" not in body and b"root:" not in body
        assert headers["Content-Type"].startswith("text/plain")


def test_requests_in_the_name_of_another_host_and_other_methods_are_refused(bundle: Path) -> None:
    with served(site_of(bundle)) as address:
        port = urlsplit(address).port
        assert ask(address, "/", host="evil.example")[0] == 403
        assert ask(address, "/", host=f"evil.example:{port}")[0] == 403
        assert ask(address, "/", host=f"localhost:{port}")[0] == 200
        assert ask(address, "/", "POST")[0] == 501
        with pytest.raises(PageError, match="cannot listen at"):
            serve(site_of(bundle), port=port)


FILE = {"bytes": 25, "sha256": hashlib.sha256(b"<script>alert(1)</script>").hexdigest()}


def whole(folder: Path, path: Path) -> None:
    """Write a bundle in one file with all files of the folder, as another program could."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_STORED) as archive:
        for file in sorted(folder.iterdir()):
            archive.write(file, file.name)


def test_what_is_no_longer_what_bundle_json_says_is_not_sent_at_any_time(bundle: Path, tmp_path: Path) -> None:
    copy, elsewhere = shutil.copytree(bundle, tmp_path / "copy"), tmp_path / "elsewhere"
    (elsewhere / "same").mkdir(parents=True)
    shutil.copy(copy / "surfels.ply", elsewhere / "same")
    secret = elsewhere / "secret"
    secret.write_bytes(bytes((copy / "surfels.ply").stat().st_size))
    site, whole = site_of(copy), (copy / "surfels.ply").read_bytes()
    with served(site) as address:
        assert ask(address, "/bundle/surfels.ply")[0] == 200
        for target in (secret, elsewhere / "same" / "surfels.ply", Path("/dev/zero"), Path("/etc/passwd")):
            (copy / "surfels.ply").unlink()
            (copy / "surfels.ply").symlink_to(target)
            for _ in range(100):  # requests during a transfer share its old copy
                status, _, data = ask(address, "/bundle/surfels.ply")
                if status == 404:
                    break
                assert data == whole
                time.sleep(0.02)
            assert status == 404
            assert main(["view", str(copy), "--export", str(tmp_path / "site")]) == 1
            assert main(["pack", str(copy), "--output", str(tmp_path / "copy.bitymi")]) == 1
    with pytest.raises(BundleError, match="leads out of the bundle"):
        site.read("bundle/surfels.ply")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["copy", "elsewhere"]
    with pytest.raises(BundleError, match="not a bundle"):
        site_of(tmp_path)


def test_a_bundle_that_is_exported_again_with_other_files_is_served_as_it_is_then(bundle: Path, tmp_path: Path) -> None:
    copy = Path(shutil.copytree(bundle, tmp_path / "copy"))
    amend(copy, lambda info: info["files"].pop("photograph-0001.jpg"))
    with served(site_of(copy)) as address:
        assert ask(address, "/bundle/photograph-0001.jpg")[0] == 404
        shutil.copy(bundle / "bundle.json", copy)
        assert ask(address, "/bundle/photograph-0001.jpg")[0] == 200  # in the current bundle.json
        assert ask(address, "/bundle/bundle.json")[2] == (bundle / "bundle.json").read_bytes()
        amend(copy, lambda info: info["files"].pop("photograph-0001.jpg"))
        assert ask(address, "/bundle/photograph-0001.jpg")[0] == 404
        (copy / "bundle.json").unlink()
        assert ask(address, "/bundle/surfels.ply")[0] == 404
        assert ask(address, "/")[0] == 200


STRANGE = ["a.htm", "a.svg", "a.xhtml", "shell.php", "run.cgi", "index.html", "A.HTM", "photograph-0001.jpg.php", "a"]


def test_files_that_the_format_does_not_name_are_not_passed_on_and_that_is_said(
    bundle: Path, tmp_path: Path, capsys
) -> None:
    """Foreign files are not served, exported or packed in either form; copies are valid bundles."""
    strange = shutil.copytree(bundle, tmp_path / "strange")
    for name in STRANGE:
        (strange / name).write_text("<script>alert(1)</script>")
    amend(strange, lambda info: info["files"].update({name: FILE for name in STRANGE}))
    whole(strange, tmp_path / "whole.bitymi")
    for source in (strange, tmp_path / "whole.bitymi"):
        with served(site_of(source)) as address:
            assert {ask(address, f"/bundle/{name}")[0] for name in STRANGE} == {404}
            sent = json.loads(ask(address, "/bundle/bundle.json")[2])
        folder, one, packed = (tmp_path / name for name in ("site", "one", "packed.bitymi"))
        for command in (
            ["view", str(source), "--export", str(folder), "--overwrite"],
            ["view", str(source), "--export", str(one), "--one-file", "--overwrite"],
            ["pack", str(source), "--output", str(packed), "--overwrite"],
        ):
            assert main(command) == 0
            said = capsys.readouterr().err
            assert "Left out" in said and "a.htm" in said and "4 more" in said
        names = {path.name for path in folder.rglob("*")} | {path.name for path in one.rglob("*")}
        assert names.isdisjoint(set(STRANGE) - {"index.html"}) and not (folder / "bundle" / "index.html").exists()
        for result in (folder / "bundle", one / "scene.bitymi", packed):
            found, checks = check_files(result)
            assert found is not None and all(check.ok for check in checks)
            assert (
                found.info.files.keys()
                == sent["files"].keys()
                == json.loads((bundle / "bundle.json").read_text())["files"].keys()
            )


def test_an_exported_page_is_complete_and_replaces_only_its_like(bundle: Path, tmp_path: Path, capsys) -> None:
    folder = tmp_path / "site"
    assert main(["view", str(bundle), "--export", str(folder)]) == 0
    assert "any web server" in capsys.readouterr().out
    names = {path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()}
    assert {"index.html", "index.js", "index.css", "view.json", "bundle/bundle.json", "bundle/surfels.ply"} <= names
    assert "bundle/config.yml" not in names
    assert (folder / "bundle" / "atlas.ktx2").read_bytes() == (bundle / "atlas.ktx2").read_bytes()
    assert main(["view", str(bundle), "--export", str(folder)]) == 1
    assert "--overwrite" in capsys.readouterr().err
    for name in ("mine.html", "bundle/mine.txt"):
        (folder / name).write_text("x")
        assert main(["view", str(bundle), "--export", str(folder), "--overwrite"]) == 1
        assert f"also holds {name}, which would be lost" in capsys.readouterr().err and (folder / name).is_file()
        (folder / name).unlink()
    assert main(["view", str(bundle), "--export", str(folder), "--overwrite"]) == 0
    other = tmp_path / "other"
    other.mkdir()
    (other / "precious").write_text("x")
    with pytest.raises(PageError, match="is not an exported page and is not replaced"):
        write_static(site_of(bundle), other, overwrite=True)
    assert (other / "precious").read_text() == "x"


def test_notes_come_and_go_while_a_bundle_is_served_and_are_exported_with_it(
    bundle: Path, tmp_path: Path, capsys
) -> None:
    copy, site, one = (tmp_path / name for name in ("copy", "site", "one"))
    shutil.copytree(bundle, copy)

    def asked(address: str) -> tuple[bool, int]:
        return json.loads(ask(address, "/view.json")[2])["notes"], ask(address, "/bundle/notes.json")[0]

    with served(site_of(copy)) as address:
        assert asked(address) == (False, 404)
        (copy / "notes.json").write_bytes(text(NOTES))
        assert asked(address) == (True, 200)
        assert ask(address, "/bundle/notes.json")[2] == text(NOTES)
        (copy / "notes.json").write_text("{}")
        assert asked(address) == (True, 404)  # the page reports that it cannot be read
    (copy / "notes.json").write_bytes(text(NOTES))
    write_static(site_of(copy), site)
    write_static(single_site(copy), one)
    assert json.loads((site / "view.json").read_text())["notes"] and notes_of(site / "bundle") == text(NOTES)
    assert notes_of(one / "scene.bitymi") == text(NOTES)
    write_static(site_of(copy), site, overwrite=True)
    (copy / "notes.json").unlink()
    assert main(["view", str(copy), "--export", str(site), "--overwrite"]) == 1
    assert "also holds bundle/notes.json, which would be lost" in capsys.readouterr().err


def test_a_bundle_in_one_file_is_sent_and_exported_as_its_parts(bundle: Path, tmp_path: Path) -> None:
    single = tmp_path / "little.bitymi"
    write_single(bundle, single)
    with served(site_of(single)) as address:
        for name in ("bundle.json", "surfels.ply", "photograph-0001.jpg"):
            assert ask(address, f"/bundle/{name}")[2] == (bundle / name).read_bytes()
        assert json.loads(ask(address, "/view.json")[2]) == {"title": "little", "notes": False}
        assert ask(address, "/little.bitymi")[0] == 404 and ask(address, "/bundle/config.yml")[0] == 404
        single.write_bytes(single.read_bytes()[:-30])
        assert ask(address, "/bundle/surfels.ply")[0] == 404
    write_single(bundle, single)
    write_static(site_of(single), tmp_path / "site")
    assert (tmp_path / "site" / "bundle" / "atlas.ktx2").read_bytes() == (bundle / "atlas.ktx2").read_bytes()


def test_the_command_says_where_and_ends_with_ctrl_c(bundle: Path) -> None:
    command = [sys.executable, "-m", "bitymi_ns", "view", str(bundle), "--no-open-browser"]
    # background jobs of a shell ignore Ctrl-C
    heeds = partial(signal.signal, signal.SIGINT, signal.SIG_DFL)
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, preexec_fn=heeds) as process:
        assert process.stdout is not None
        line = process.stdout.readline()
        assert "http://127.0.0.1:" in line and str(bundle) in line
        process.send_signal(signal.SIGINT)
        try:
            assert process.wait(timeout=60) == 0
        finally:
            process.kill()  # or leaving the block would block


def raw(address: str, data: bytes, finish: bool = False) -> bytes:
    """Send bytes and return the response until the server closes the connection."""
    parts = urlsplit(address)
    with socket.create_connection((parts.hostname, parts.port), timeout=20) as connection:
        connection.sendall(data)
        if finish:
            connection.shutdown(socket.SHUT_WR)
        found = b""
        while piece := connection.recv(1 << 16):
            found += piece
        return found


@pytest.mark.parametrize(
    "request_line, status",
    [
        ("GET http://[/ HTTP/1.1", 400),
        ("GET http://[::1/x HTTP/1.1", 400),
        ("GET / HTTP/9.9.9", 400),
        ("GET / x HTTP/1.1", 400),
        ("GET / HTTP/3.0", 505),
        ("TRACE / HTTP/1.1", 501),
        ("<b> / HTTP/1.1", 501),
        ("GET /%ff%00 HTTP/1.1", 404),
        ("GET /" + "a" * 70_000 + " HTTP/1.1", 414),
    ],
)
def test_a_request_that_is_none_is_answered_as_such(bundle: Path, request_line: str, status: int) -> None:
    with served(site_of(bundle)) as address:
        answer = raw(address, f"{request_line}\r\nHost: localhost\r\n\r\n".encode(), finish=True)
        head, _, body = answer.partition(b"\r\n\r\n")
        assert head.startswith(f"HTTP/1.1 {status} ".encode()) and answer.count(b"HTTP/1.1") == 1
        assert b"default-src 'none'" in head and b"text/plain" in head and b"<" not in body
        assert ask(address, "/")[0] == 200


@pytest.mark.parametrize("method", ["GET", "HEAD", "POST"])
@pytest.mark.parametrize(
    "header",
    [
        *("Content-Length: 40", "Transfer-Encoding: chunked", "content-length: 40\r\nContent-Length: 0"),
        *("Content-Length: 0\r\nContent-Length: 40", "Transfer-Encoding : chunked", "no header", "Host: localhost"),
    ],
)
def test_a_body_is_no_second_request(bundle: Path, method: str, header: str) -> None:
    second = b"GET /index.js HTTP/1.1\r\nHost: localhost\r\n\r\n"
    with served(site_of(bundle)) as address:
        answer = raw(address, f"{method} / HTTP/1.1\r\nHost: localhost\r\n{header}\r\n\r\n".encode() + second)
    assert answer.count(b"HTTP/1.1 ") == 1 and b"HTTP/1.1 200" not in answer


@pytest.mark.slow
@pytest.mark.parametrize("data", [b"", b"GET / HT", b"GET / HTTP/1.1\r\nHost: localhost\r\n", b"drip"])
def test_half_a_request_is_not_waited_for(bundle: Path, data: bytes) -> None:
    begin = time.monotonic()
    with served(site_of(bundle), request_seconds=0.4) as address:
        parts = urlsplit(address)
        with socket.create_connection((parts.hostname, parts.port), timeout=10) as connection:
            connection.sendall(data if data != b"drip" else b"GET / HTTP/1.1\r\n")
            with suppress(ConnectionError):
                while data == b"drip" and time.monotonic() - begin < 3:
                    connection.sendall(b"A")
                    time.sleep(0.05)
                assert connection.recv(100) == b""
        assert time.monotonic() - begin < 2.5


@pytest.mark.parametrize("host", ["127.0.0.2", "localhost", "127.1", "::1", "0.0.0.0"])
def test_every_address_of_this_machine_answers_to_its_name(bundle: Path, host: str) -> None:
    try:
        server = serve(site_of(bundle), host)
    except PageError as error:
        pytest.skip(str(error))  # no IPv6
    with running(server) as address:
        assert ask(address, "/")[0] == 200
        assert ask(address, "/", host="evil.example")[0] == (200 if host == "0.0.0.0" else 403)
        assert is_loopback(server) == (host != "0.0.0.0")


@pytest.mark.parametrize(
    "options, said",
    [
        (["--port", "99999"], "the port must be from 0 to 65535, not 99999"),
        (["--port", "-1"], "the port must be from 0 to 65535, not -1"),
        (["--host", "192.0.2.1"], "cannot listen at"),
        (["--host", "127.0.0.1.5"], "cannot listen at"),
        (["--host", "a..b"], "cannot listen at"),
        (["--host", "::zz"], "cannot listen at"),
    ],
)
def test_an_address_that_is_none_is_said(bundle: Path, options: list[str], said: str, capsys) -> None:
    assert main(["view", str(bundle), "--no-open-browser", *options]) == 1
    assert said in capsys.readouterr().err
