"""A step of COLMAP through pycolmap: STEP FOLDER SIDE FEATURES. Without arguments: pycolmap's version."""
import sys

import pycolmap


def with_sift(side, features):
    """Where pycolmap keeps the options of feature extraction: its version 4 moved the picture's size out of SIFT's."""
    if hasattr(pycolmap, "FeatureExtractionOptions"):
        options = pycolmap.FeatureExtractionOptions()
        options.max_image_size, options.use_gpu = side, False
        options.sift.max_num_features = features
        return {"extraction_options": options}
    options = pycolmap.SiftExtractionOptions()
    options.max_image_size, options.max_num_features = side, features
    return {"sift_options": options}


def run(step, folder, side, features):
    database, images, models = (f"{folder}/{name}" for name in ("database.db", "images", "sparse"))
    if step == "features":
        mode, device = pycolmap.CameraMode.PER_FOLDER, pycolmap.Device.cpu
        pycolmap.extract_features(database, images, camera_mode=mode, device=device, **with_sift(side, features))
    elif step == "all":
        pycolmap.match_exhaustive(database, device=pycolmap.Device.cpu)
    elif step == "near":
        pycolmap.match_sequential(database, device=pycolmap.Device.cpu)
    elif step == "cameras":
        options = pycolmap.IncrementalPipelineOptions()
        options.min_model_size = 2
        options.triangulation.ignore_two_view_tracks = False
        if not pycolmap.incremental_mapping(database, images, models, options=options):
            sys.exit("failed to create sparse model")


if len(sys.argv) == 1:
    print(pycolmap.__version__)
else:
    run(sys.argv[1], sys.argv[2], int(sys.argv[3]), int(sys.argv[4]))
