"""Writes reference.json: images of directions and directions of image points, by OpenCV and COLMAP themselves.

    pip install opencv-python-headless pycolmap numpy
    python reference.py > reference.json

Directions have the axes of OpenCV (x right, y down, z forward) and z = 1; points are in pixels. Neither source treats angles of 90 degrees
and more.
"""

import json

import cv2
import numpy as np
import pycolmap

WIDTH, HEIGHT = 1000, 750
PARAMETERS = {
    "SIMPLE_PINHOLE": [620.5, 510.25, 369.5],
    "PINHOLE": [620.5, 615.25, 510.25, 369.5],
    "SIMPLE_RADIAL": [620.5, 510.25, 369.5, -0.11],
    "RADIAL": [620.5, 510.25, 369.5, -0.21, 0.06],
    "OPENCV": [620.5, 615.25, 510.25, 369.5, -0.24, 0.07, 0.0015, -0.0021],
    "FULL_OPENCV": [620.5, 615.25, 510.25, 369.5, 0.31, -0.12, 0.0015, -0.0021, 0.023, 0.52, -0.07, 0.011],
    "OPENCV_FISHEYE": [460.5, 455.25, 510.25, 369.5, 0.032, -0.011, 0.0042, -0.0007],
    "FOV": [620.5, 615.25, 510.25, 369.5, 0.93],
    "SIMPLE_RADIAL_FISHEYE": [460.5, 510.25, 369.5, -0.031],
    "RADIAL_FISHEYE": [460.5, 510.25, 369.5, -0.031, 0.004],
    "THIN_PRISM_FISHEYE": [460.5, 455.25, 510.25, 369.5, 0.032, -0.011, 0.0013, -0.0017, 0.0042, -0.0007, 0.0011, -0.0008],
    "SIMPLE_FISHEYE": [460.5, 510.25, 369.5],
    "FISHEYE": [460.5, 455.25, 510.25, 369.5],
}
COLUMNS = np.linspace(20.5, WIDTH - 20.5, 7)
ROWS = np.linspace(15.5, HEIGHT - 15.5, 5)
POINTS = np.array([[x, y] for y in ROWS for x in COLUMNS])
# Iterations until the last digits of a double.
EXACT = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 2000, 1e-15)


def camera_matrix(p):
    return np.array([[p[0], 0, p[2]], [0, p[1], p[3]], [0, 0, 1]])


def opencv(model):
    p = PARAMETERS[model]
    matrix, lens, none = camera_matrix(p), np.array(p[4:]), np.zeros(3)
    module = cv2.fisheye if model == "OPENCV_FISHEYE" else cv2
    plane = module.undistortPoints(POINTS[:, None], matrix, lens, criteria=EXACT)[:, 0]
    directions = rounded(plane)
    pixels = module.projectPoints(directions[:, None], none, none, matrix, lens)[0][:, 0]
    return directions, pixels, plane


def colmap(model):
    camera = pycolmap.Camera(model=model, width=WIDTH, height=HEIGHT, params=PARAMETERS[model])
    plane = np.array(camera.cam_from_img(POINTS))
    directions = rounded(plane)
    return directions, np.array(camera.img_from_cam(directions)), plane


def rounded(plane):
    """Directions near those of the points: what is distorted does not depend on how exactly the source undistorts."""
    return np.c_[plane.round(3), np.ones(len(plane))]


def case(source, model, found):
    directions, pixels, plane = (a.tolist() for a in found)
    return {"source": source, "model": model, "parameters": PARAMETERS[model], "size": [WIDTH, HEIGHT],
            "distorted": [d[:2] + p for d, p in zip(directions, pixels)], "undistorted": [p + d for p, d in zip(POINTS.tolist(), plane)]}


cases = [case(f"OpenCV {cv2.__version__}", model, opencv(model)) for model in ["OPENCV", "FULL_OPENCV", "OPENCV_FISHEYE"]]
cases += [case(f"COLMAP {pycolmap.__version__}", model, colmap(model)) for model in PARAMETERS]
print("[\n" + ",\n".join(json.dumps(c) for c in cases) + "\n]")
