"""A small Hugging Face Hub on loopback: the routes that ``huggingface_hub`` calls for dataset repositories.

Content-addressed storage, commits with parents, tokens for writing, LFS uploads whose digest is checked.
What it cannot show: the real Hub's Xet storage, its limits and permissions, and its page of a card.
"""

from __future__ import annotations

import base64
import hashlib
import json
import threading
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any
from urllib.parse import parse_qs, unquote, urlsplit

TOKEN = "hf_loopback"


@dataclass
class Commit:
    """One state of a repository: path -> (content, whether it is an LFS file)."""

    oid: str
    title: str
    files: dict[str, tuple[bytes, bool]]


@dataclass
class Hub:
    """Repositories by id, uploaded LFS objects by digest, and what was asked."""

    repositories: dict[str, list[Commit]] = field(default_factory=dict)
    objects: dict[str, bytes] = field(default_factory=dict)
    requests: list[str] = field(default_factory=list)
    fail_once_on: str = ""
    lock: threading.RLock = field(default_factory=threading.RLock)

    def head(self, repo: str) -> Commit:
        return self.repositories[repo][-1]

    def commit(self, repo: str, title: str, files: dict[str, tuple[bytes, bool]]) -> Commit:
        history = self.repositories[repo]
        oid = hashlib.sha1(f"{repo} {len(history)} {title}".encode()).hexdigest()
        history.append(Commit(oid, title, {**history[-1].files, **files}))
        return history[-1]


class HubServer:
    """Serves a :class:`Hub` on a free port of loopback while the context lasts."""

    def __init__(self) -> None:
        self.hub = Hub()
        handler = type("Handler", (_Handler,), {"hub": self.hub})
        self._server = ThreadingHTTPServer(("127.0.0.1", 0), handler)
        self.url = f"http://127.0.0.1:{self._server.server_address[1]}"

    def __enter__(self) -> HubServer:
        self._thread = threading.Thread(target=self._server.serve_forever, daemon=True)
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()


class RefusalError(Exception):
    """An answer that is an error: status, message, and the Hub's error code."""

    def __init__(self, status: int, message: str, code: str = "") -> None:
        super().__init__(message)
        self.status, self.code = status, code


class _Handler(BaseHTTPRequestHandler):
    hub: Hub
    protocol_version = "HTTP/1.1"

    def log_message(self, *_: Any) -> None:
        pass

    def do_GET(self) -> None:
        self._answer(self._get)

    def do_HEAD(self) -> None:
        self._answer(self._get)

    def do_POST(self) -> None:
        self._answer(self._post)

    def do_PUT(self) -> None:
        self._answer(self._put)

    def _answer(self, route: Any) -> None:
        parts = urlsplit(self.path)
        length = int(self.headers.get("Content-Length") or 0)
        self.body = self.rfile.read(length)
        self.query = parse_qs(parts.query)
        path = unquote(parts.path)
        with self.hub.lock:
            self.hub.requests.append(f"{self.command} {path}")
            try:
                if self.hub.fail_once_on and self.hub.fail_once_on in path:
                    self.hub.fail_once_on = ""
                    raise RefusalError(403, "refused once")
                route(path)
            except RefusalError as error:
                headers = {"X-Error-Message": str(error)} | (
                    {"X-Error-Code": error.code} if error.code else {}
                )
                self._send(error.status, {"error": str(error)}, headers)

    def _send(self, status: int, body: Any, headers: dict[str, str] | None = None) -> None:
        data = body if isinstance(body, bytes) else json.dumps(body).encode()
        self.send_response(status)
        kind = "application/octet-stream" if isinstance(body, bytes) else "application/json"
        for key, value in {"Content-Type": kind, "Content-Length": str(len(data)), **(headers or {})}.items():
            self.send_header(key, value)
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(data)

    # Reading

    def _get(self, path: str) -> None:
        if path == "/api/datasets":
            author = self.query.get("author", [""])[0]
            found = [repo for repo in self.hub.repositories if repo.startswith(f"{author}/")]
            wanted = self.query.get("search", [""])[0]
            self._send(200, [_info(repo, self.hub.head(repo)) for repo in found if wanted in repo])
        elif path.startswith("/api/datasets/"):
            user, name, *rest = path.removeprefix("/api/datasets/").split("/")
            commit = self._commit(f"{user}/{name}", rest[1] if len(rest) > 1 else "main")
            if rest[:1] == ["tree"]:
                folder = "/".join(rest[2:])
                self._send(
                    200, [_entry(*item) for item in commit.files.items() if item[0].startswith(folder)]
                )
            else:
                self._send(200, _info(f"{user}/{name}", commit))
        elif path.startswith("/cdn/"):
            self._send(200, self.hub.objects[path.removeprefix("/cdn/")])
        elif "/resolve/" in path:
            self._resolve(path)
        else:
            raise RefusalError(404, f"no route {path}")

    def _resolve(self, path: str) -> None:
        repo, _, rest = path.removeprefix("/datasets/").partition("/resolve/")
        revision, _, name = rest.partition("/")
        commit = self._commit(repo, revision)
        if name not in commit.files:
            self.send_commit = commit.oid
            raise RefusalError(404, "Entry not found", "EntryNotFound")
        content, large = commit.files[name]
        headers = {"X-Repo-Commit": commit.oid, "ETag": f'"{_blob_id(content)}"'}
        if not large:
            self._send(200, content, headers)
            return
        oid = hashlib.sha256(content).hexdigest()
        linked = {"X-Linked-Etag": f'"{oid}"', "X-Linked-Size": str(len(content))}
        # Another host, as the real one's: a client must not ask it for what only the Hub knows.
        host = self.headers["Host"].replace("127.0.0.1", "localhost")
        self._send(302, b"", headers | linked | {"Location": f"http://{host}/cdn/{oid}"})

    def _commit(self, repo: str, revision: str) -> Commit:
        if repo not in self.hub.repositories:
            raise RefusalError(404, "Repository not found", "RepoNotFound")
        if revision == "main":
            return self.hub.head(repo)
        for commit in self.hub.repositories[repo]:
            if commit.oid == revision:
                return commit
        raise RefusalError(404, "Invalid rev id", "RevisionNotFound")

    # Writing

    def _post(self, path: str) -> None:
        if path == "/api/validate-yaml":
            self._send(200, {"errors": [], "warnings": []})
            return
        if "/paths-info/" in path:
            files = self._commit(*path.removeprefix("/api/datasets/").split("/paths-info/")).files
            wanted = parse_qs(self.body.decode())["paths"]
            self._send(200, [_entry(name, files[name]) for name in wanted if name in files])
            return
        if self.headers.get("Authorization") != f"Bearer {TOKEN}":
            raise RefusalError(401, "Invalid credentials in Authorization header")
        if path == "/api/repos/create":
            self._create(json.loads(self.body))
        elif path.endswith("/info/lfs/objects/batch"):
            self._send(200, {"objects": [self._object(item) for item in json.loads(self.body)["objects"]]})
        elif "/preupload/" in path:
            repo = path.removeprefix("/api/datasets/").partition("/preupload/")[0]
            head = self._commit(repo, "main")
            self._send(200, {"files": [_mode(file, head) for file in json.loads(self.body)["files"]]})
        elif "/commit/" in path:
            self._make_commit(path.removeprefix("/api/datasets/").partition("/commit/")[0])
        else:
            raise RefusalError(404, f"no route {path}")

    def _create(self, wanted: dict[str, Any]) -> None:
        repo = f"{wanted['organization']}/{wanted['name']}"
        if not repo.startswith("user/"):
            raise RefusalError(403, "You don't have the rights to create a dataset under this namespace")
        url = f"http://{self.headers['Host']}/datasets/{repo}"
        if repo in self.hub.repositories:
            self._send(409, {"error": "You already created this dataset repo", "url": url})
            return
        self.hub.repositories[repo] = [Commit(hashlib.sha1(repo.encode()).hexdigest(), "initial commit", {})]
        self._send(200, {"url": url, "name": repo, "id": repo})

    def _object(self, wanted: dict[str, Any]) -> dict[str, Any]:
        if wanted["oid"] in self.hub.objects:
            return wanted
        host = f"http://{self.headers['Host']}"
        return wanted | {"actions": {"upload": {"href": f"{host}/upload/{wanted['oid']}"}}}

    def _put(self, path: str) -> None:
        oid = path.removeprefix("/upload/")
        if hashlib.sha256(self.body).hexdigest() != oid:
            raise RefusalError(400, "the content does not have the digest")
        self.hub.objects[oid] = self.body
        self._send(200, {})

    def _make_commit(self, repo: str) -> None:
        lines = [json.loads(line) for line in self.body.splitlines() if line]
        header = lines[0]["value"]
        if header.get("parentCommit", self._commit(repo, "main").oid) != self.hub.head(repo).oid:
            raise RefusalError(412, "A commit has happened since. Please refresh and try again.")
        files: dict[str, tuple[bytes, bool]] = {}
        for line in lines[1:]:
            value = line["value"]
            if line["key"] == "file":
                files[value["path"]] = (base64.b64decode(value["content"]), False)
            elif line["key"] == "lfsFile":
                files[value["path"]] = (self.hub.objects[value["oid"]], True)
            else:
                raise RefusalError(400, f"cannot {line['key']}")
        commit = self.hub.commit(repo, header["summary"], files)
        url = f"http://{self.headers['Host']}/datasets/{repo}/commit/{commit.oid}"
        self._send(200, {"commitUrl": url, "commitOid": commit.oid, "success": True})


def _mode(file: dict[str, Any], head: Commit) -> dict[str, Any]:
    large = file["path"].endswith(".hdf5")
    known = head.files.get(file["path"])
    oid = None
    if known is not None:
        oid = hashlib.sha256(known[0]).hexdigest() if known[1] else _blob_id(known[0])
    return {
        "path": file["path"],
        "uploadMode": "lfs" if large else "regular",
        "shouldIgnore": False,
        "oid": oid,
    }


def _blob_id(content: bytes) -> str:
    return hashlib.sha1(b"blob %d\0" % len(content) + content).hexdigest()


def _info(repo: str, commit: Commit) -> dict[str, Any]:
    return {
        "_id": repo,
        "id": repo,
        "sha": commit.oid,
        "private": False,
        "tags": [],
        "downloads": 0,
        "likes": 0,
        "siblings": [{"rfilename": name} for name in commit.files],
    }


def _entry(path: str, file: tuple[bytes, bool]) -> dict[str, Any]:
    content, large = file
    entry: dict[str, Any] = {"type": "file", "path": path, "size": len(content), "oid": _blob_id(content)}
    if large:
        oid = hashlib.sha256(content).hexdigest()
        entry["lfs"] = {"oid": oid, "size": len(content), "pointerSize": 132}
    return entry
