use crate::Folder;
use zipsplat::types::{read_ply, read_points};

#[test]
fn vggt_gives_depth_cameras_and_scenes() {
    let folder = Folder::new().with_vggt();
    let weights = "--weights @/vggt.safetensors";
    let json = folder.run(&format!("depth @/photos {weights} --input-size 42 -o @/depth --json")).json();
    assert_eq!((&json["views"], &json["width"], &json["height"]), (&2.into(), &42.into(), &28.into()));
    let bytes = folder.read("depth/depths.safetensors");
    let values = safetensors::SafeTensors::deserialize(&bytes).unwrap();
    assert_eq!(values.tensor("depth").unwrap().shape(), [2, 28, 42]);
    assert!(values.tensor("confidence").is_ok() && values.tensor("rays").is_err() && values.tensor("points").is_err());

    let line = format!("cameras @/photos --with vggt {weights} --matching-size 64");
    let found = folder.run(&format!("{line} -o @/found.json --json")).json();
    assert_eq!((&found["registered"], &found["program"]), (&2.into(), &"vggt-micro".into()), "{found}");
    folder.run(&format!("depth @/photos {weights} --input-size 64 -o @/same")).success();
    let cameras = |name: &str| folder.capture(name).frames.iter().map(|frame| frame.camera).collect::<Vec<_>>();
    assert_eq!(cameras("found.json"), cameras("same/transforms.json"));
    let points = folder.capture("found.json").points.expect("they lie beside it");
    assert!(read_points(points).unwrap().positions.len() > 100);

    let find = "--poses vggt --depth-weights @/vggt.safetensors --matching-size 64";
    let micro = "--weights @/micro.safetensors --input-size 28x28";
    assert_eq!(folder.run(&format!("reconstruct @/photos {find} {micro} -o @/a.ply --json")).json()["photos"], 2);
    folder.run(&format!("reconstruct @/photos {weights} --input-size 42x42 --cameras vggt -o @/b.ply")).success();
    assert!(read_ply(folder.path("b.ply")).unwrap().len() > 100);
    assert!(folder.run("convert @/vggt.safetensors").success().contains("vggt-micro of VGGT"));
    folder.run("convert @/vggt.safetensors @/half.safetensors --dtype f16").success();
    folder.run("depth @/photos --weights @/half.safetensors --input-size 42 -o @/half").success();
}

#[test]
fn vggts_point_head_gives_the_points() {
    let folder = Folder::new().with_depth().with_vggt();
    let options = "--point-head --input-size 42 -o @/depth";
    let json = folder.run(&format!("depth @/photos --weights @/vggt.safetensors {options} --json")).json();
    let bytes = folder.read("depth/depths.safetensors");
    let values = safetensors::SafeTensors::deserialize(&bytes).unwrap();
    let (points, confidence) = (values.tensor("points").unwrap(), values.tensor("point_confidence").unwrap());
    assert_eq!((points.shape(), confidence.shape()), (&[2, 28, 42, 3][..], &[2, 28, 42][..]));
    let cloud = read_points(folder.path("depth/points.ply")).unwrap();
    assert_eq!(json["points"], cloud.positions.len());
    let (rows, _) = points.data().as_chunks::<12>();
    let bytes_of = |point: &[f32; 3]| point.map(f32::to_le_bytes).concat();
    assert!(cloud.positions.iter().all(|point| rows.iter().any(|row| row[..] == bytes_of(point)[..])));
    folder.run("convert @/vggt.safetensors @/copy.safetensors").success();
    folder.run(&format!("depth @/photos --weights @/copy.safetensors {options} --overwrite")).success();
    assert!(folder.read("depth/depths.safetensors") == bytes, "points of converted weights");
    let refused = folder.run(&format!("depth @/photos --weights @/da3.safetensors {options} --overwrite"));
    refused.fails(3, &["network for points", "da3-micro", "VGGT"]);
}

/// Portrait and landscape photos are scaled to equal areas, as for Depth Anything 3.
#[test]
fn mixed_orientations_keep_equal_shares_with_vggt() {
    let folder = Folder::new().with_depth().with_vggt();
    folder.make("mixed");
    crate::photo(96, 64, 0).save_png(folder.path("mixed/wide.png")).expect("a photo");
    crate::photo(64, 96, 1).save_png(folder.path("mixed/tall.png")).expect("a photo");
    for weights in ["vggt", "da3"] {
        let line = format!("depth @/mixed --weights @/{weights}.safetensors --input-size 84 -o @/{weights} --json");
        let json = folder.run(&line).json();
        assert_eq!((&json["width"], &json["height"]), (&56.into(), &56.into()), "{weights}");
    }
}

#[test]
fn the_decoder_on_vggt_reconstructs() {
    let folder = Folder::new().with_vggt();
    let weights = "--weights @/tokens.safetensors --input-size 28x42";
    let plan = folder.run(&format!("info --plan --views 2 {weights} --json")).json();
    let run = folder.run(&format!("reconstruct @/photos {weights} -o @/scene.ply --json")).json();
    assert_eq!(plan["peak_bytes"], run["peak_bytes"]);
    let options = "--views 24 --weights seeded:vggt --precision fp16 --json";
    let plan = folder.run(&format!("--device none info --plan {options}")).json();
    let weights_of = plan["weight_bytes"].as_u64().expect("a number");
    assert!((1_800_000_000..2_600_000_000).contains(&weights_of), "{weights_of}");
    let options = "--views 2 --input-size 28x28 --precision fp32 --warmup 0 --repeats 1 --json";
    let rows = folder.run(&format!("bench forward --weights @/tokens.safetensors {options}")).json();
    assert!(rows.as_array().is_some_and(|rows| rows.iter().any(|row| row["stage"] == "backbone")), "{rows}");
}

#[test]
fn what_vggt_cannot_do_is_refused() {
    let folder = Folder::new().with_depth().with_vggt();
    folder.run("cameras @/photos --method vggt --weights @/vggt.safetensors -o @/known.json").success();
    let known = "--cameras @/known.json";
    let refused = ["cameras", "none: vggt-micro has no camera encoder", "Depth Anything 3"];
    folder.run(&format!("depth @/photos --weights @/vggt.safetensors {known} -o @/out")).fails(3, &refused);
    for weights in ["vggt", "tokens"] {
        let line =
            format!("reconstruct @/photos --weights @/{weights}.safetensors {known} --input-size 42x42 -o @/a.ply");
        folder.run(&line).fails(3, &refused);
    }
    let rays = "cameras @/photos --method vggt --weights @/vggt.safetensors --camera-source rays -o @/rays.json";
    folder.run(rays).fails(3, &["rays", "Depth Anything 3"]);
    for (method, weights, expected) in
        [("vggt", "da3", "weights of VGGT"), ("da3", "vggt", "weights of Depth Anything 3")]
    {
        let line = format!("cameras @/photos --method {method} --weights @/{weights}.safetensors -o @/other.json");
        folder.run(&line).fails(3, &[&format!("{weights}-micro"), expected]);
    }
    folder.run("cameras @/photos --method vggt -o @/none.json").fails_usage();
}
