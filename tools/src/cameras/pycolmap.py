"""A step of COLMAP through pycolmap: STEP FOLDER MODELS and the numbers of the step. Without arguments: pycolmap's version."""
import os
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


def mapped_with(seed, first_angle, first_points, points, refines_lens, ignores_pairs, growth, tolerance, repetitions):
    """The options of mapping."""
    pycolmap.set_random_seed(seed)
    options = pycolmap.IncrementalPipelineOptions()
    options.min_model_size = 2
    options.mapper.init_min_tri_angle = first_angle
    options.mapper.init_min_num_inliers = first_points
    options.mapper.abs_pose_min_num_inliers = points
    options.ba_refine_focal_length = options.ba_refine_extra_params = bool(refines_lens)
    options.triangulation.ignore_two_view_tracks = bool(ignores_pairs)
    # Version 4 counts frames of several cameras.
    ratio = "ba_global_frames_ratio" if hasattr(options, "ba_global_frames_ratio") else "ba_global_images_ratio"
    setattr(options, ratio, growth)
    options.ba_global_points_ratio = growth
    options.ba_global_max_refinements = repetitions
    for name in ("ba_global_function_tolerance", "ba_local_function_tolerance"):
        if hasattr(options, name):
            setattr(options, name, tolerance)
    return options


def run(step, folder, models, numbers):
    database, images = f"{folder}/database.db", f"{folder}/images"
    if step == "features":
        mode, device, options = pycolmap.CameraMode.PER_FOLDER, pycolmap.Device.cpu, with_sift(*numbers)
        if os.path.isdir(f"{folder}/masks"):
            options["reader_options"] = pycolmap.ImageReaderOptions()
            options["reader_options"].mask_path = f"{folder}/masks"
        pycolmap.extract_features(database, images, camera_mode=mode, device=device, **options)
    elif step == "all":
        pycolmap.match_exhaustive(database, device=pycolmap.Device.cpu)
    elif step == "near":
        pycolmap.match_sequential(database, device=pycolmap.Device.cpu)
    elif step == "pairs":
        # Matches unmatched pairs first. Before version 4, `match_image_pairs` is missing.
        pycolmap.verify_matches(database, f"{folder}/pairs.txt")
    elif step == "cameras":
        if not pycolmap.incremental_mapping(database, images, models, options=mapped_with(*numbers)):
            sys.exit("failed to create sparse model")


if len(sys.argv) == 1:
    print(pycolmap.__version__)
else:
    run(*sys.argv[1:4], [float(number) if "." in number else int(number) for number in sys.argv[4:]])
