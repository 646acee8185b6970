#!/usr/bin/env python3
"""Clicks an object of a run and saves it as a .ply, through the page's API. Needs no package.

    segwild serve runs/trevi                                   # prints the address of the page
    python3 studio.py ADDRESS PHOTO --positive X,Y ... [--negative X,Y ...] [--name NAME]

PHOTO is a photo's name; X,Y are pixels of the photo as the page shows it, at full size. `--positive` and `--negative` mean what
they mean for `segwild segment`, and each takes one position or several.
"""

import argparse
import json
import sys
import time
import urllib.parse
import urllib.request


class Studio:
    """One run of a server."""

    def __init__(self, address, run=None):
        parts = urllib.parse.urlsplit(address)
        self.root = f"{parts.scheme}://{parts.netloc}/api/v1"
        self.token = urllib.parse.parse_qs(parts.query)["token"][0]
        run = run or self.ask("/runs")[0]["name"]
        self.base = "/runs/" + urllib.parse.quote(run)
        while "photos" not in (description := self.ask(self.base)):
            time.sleep(0.2)  # the scene is being loaded, or trained
        self.photos = [photo["name"] for photo in description["photos"]]

    def ask(self, path, body=None, raw=False):
        data = None if body is None else json.dumps(body).encode()
        headers = {"Authorization": f"Bearer {self.token}", "Content-Type": "application/json"}
        try:
            answer = urllib.request.urlopen(urllib.request.Request(self.root + path, data, headers)).read()
        except urllib.error.HTTPError as error:
            sys.exit("error: " + json.loads(error.read())["error"])
        return answer if raw else json.loads(answer)

    def act(self, **action):
        return self.ask(self.base + "/act", action)

    def click(self, photo, points):
        """Asks for the object at points (x, y, inside) of a photo, and waits for the answer of all photos."""
        points = [{"x": x, "y": y, "inside": inside} for x, y, inside in points]
        state = self.act(do="prompt", prompts=[{"photo": self.photos.index(photo), "points": points}])
        while state["answer"]["state"] == "working":
            time.sleep(0.05)
            state = self.ask(self.base + "/state")
        return state["answer"]

    def keep(self, name):
        return self.act(do="keep", name=name)["objects"][-1]

    def ply(self, item):
        return self.ask(f"{self.base}/objects/{item['id']}/ply", raw=True)


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("address")
    parser.add_argument("photo")
    parser.add_argument("--positive", nargs="+", required=True, metavar="X,Y")
    parser.add_argument("--negative", nargs="*", default=[], metavar="X,Y")
    parser.add_argument("--name", default="object")
    args = parser.parse_args()
    studio = Studio(args.address)
    at = lambda text: tuple(float(v) for v in text.split(","))
    points = [(*at(p), True) for p in args.positive] + [(*at(p), False) for p in args.negative]
    answer = studio.click(args.photo, points)
    if answer["state"] != "done":
        sys.exit(f"error: {answer['error']}")
    item = studio.keep(args.name)
    with open(args.name + ".ply", "wb") as file:
        file.write(studio.ply(item))
    print(f"{args.name}.ply: {item['splats']} splats in {answer['seconds']:.2f} s")


if __name__ == "__main__":
    main()
