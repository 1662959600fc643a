use super::{assert_same_bits, pico_weights, read, write_zeros};
use zip::CompressionMethod;
use zipsplat::weights::{RECIPES, VARIANTS, convert};
use zipsplat_tests::architectures::{golden, pico};
use zipsplat_tests::{pickles::*, prelude::*};

fn list(items: &[usize]) -> Vec<u8> {
    [b"](".to_vec(), items.iter().flat_map(|&item| int(item)).collect(), b"e".to_vec()].concat()
}

/// Nested, as of the trainer.
fn conf(of: &Architecture) -> Vec<u8> {
    let vit_name = of.name.replace("da3", "vit");
    let backbone = dict(&[
        ("vit_name", text(&vit_name)),
        ("embed_dim", int(of.width)),
        ("out_layers", list(&of.out_layers)),
        ("alt_start", int(of.alt_start)),
        ("qknorm_start", int(of.qk_norm_start)),
        ("rope_start", int(of.rope_start)),
        ("cat_token", b"\x88".to_vec()),
    ]);
    let head = dict(&[("sh_degree", int(of.sh_degree)), ("max_scale", [&b"G"[..], &0.1f64.to_be_bytes()].concat())]);
    let model = dict(&[
        ("img_size", int(336)),
        ("backbone", backbone),
        ("gaussians_per_prototype", int(of.gaussians_per_token)),
        ("clustering_layer", int(0)),
        ("gaussian_head", head),
    ]);
    dict(&[("model", model), ("train", dict(&[("epochs", int(3))]))])
}

/// One f32 with strides of 0.
fn tensors(of: &Architecture, rename: impl Fn(&str) -> String) -> Vec<u8> {
    let tensor = |shape: &[usize]| {
        let strides = vec![0; shape.len()];
        View { kind: "FloatStorage", key: "0", elements: 1, offset: 0, shape, strides: &strides }.pickle()
    };
    let all: Vec<(String, Vec<u8>)> =
        of.parameters().iter().map(|(name, shape)| (rename(name), tensor(shape))).collect();
    dict(&all.iter().map(|(name, pickle)| (name.as_str(), pickle.clone())).collect::<Vec<_>>())
}

fn saved(root: &[u8]) -> Vec<u8> {
    let pickle = [b"\x80\x02", root, b"."].concat();
    archive(&[("data.pkl", &pickle), ("data/0", &0.5f32.to_le_bytes())], CompressionMethod::Stored)
}

fn open(root: &[u8], variant: Option<&str>) -> Result<Checkpoint, Error> {
    Checkpoint::from_bytes("trained.tar", saved(root), variant)
}

/// Names of a compiled, distributed model.
fn wrapped(name: &str) -> String {
    format!(
        "module.{}",
        name.replace("_attention.", "_attention._orig_mod.").replace("downscale.1", "downscale.1._orig_mod")
    )
}

#[test]
fn every_recipe_opens_by_itself() {
    for name in RECIPES.into_iter().chain(VARIANTS) {
        let expected = Architecture::named(name).unwrap();
        let conf = [("model", tensors(&expected, wrapped)), ("conf", conf(&expected)), ("epoch", int(3))];
        let opened = open(&dict(&conf), None).unwrap();
        assert_eq!(opened.architecture(), &expected);
        assert_eq!((opened.image_size(), opened.notes()), (336, &[][..]), "{name}");
        assert_eq!(read(&opened, "backbone.backbone.norm.bias")[..2], [0.5; 2]);

        // A bare state dictionary with a counter. Shapes give all but the named network's
        // out layers.
        let bare = [tensors(&expected, |name| name.into()), text("step"), int(7), b"s".to_vec()].concat();
        for variant in [None, Some(name), Some(&*name.replace("da3", "vit"))] {
            let opened = open(&bare, variant).unwrap();
            let renamed = Architecture { name: variant.unwrap_or(name).into(), ..expected.clone() };
            assert_eq!(opened.architecture(), &renamed);
            let [note] = opened.notes() else { panic!("{:?}", opened.notes()) };
            assert!(note.contains(&format!("out_layers {:?}", expected.out_layers)), "{note}");
        }
    }
}

#[test]
fn options_say_what_the_file_does_not() {
    let trained = Architecture { alt_start: 3, rope_start: 6, ..Architecture::new("vits", 384, 12, 5, &[2, 11]) };
    let bare = tensors(&trained, wrapped);
    let expected = "vits:out_layers=2,11:alt_start=3:rope_start=6";
    assert_eq!(open(&bare, Some(expected)).unwrap().architecture(), &trained);
    assert_refused(open(&bare, Some("vits")), &["12 blocks with 2 out layers", "out_layers=A,B,.."]);
    // The variant overrides the configuration, but not the shapes.
    let with_conf = dict(&[("model", bare), ("conf", conf(&trained))]);
    assert_eq!(open(&with_conf, Some("out_layers=1,11")).unwrap().architecture().out_layers, [1, 11]);
    for (variant, words) in [
        ("vitb", "found vitb, expected a network of width 384 and 12 blocks"),
        ("vits:depth=3", "field of the variant: found depth"),
        ("vits:out_layers=1,x", "out_layers of the variant: found x"),
        ("vits:vitb", "found vitb, expected FIELD=VALUE"),
        ("out_layers=11,2", "out_layers"),
    ] {
        assert_refused(open(&with_conf, Some(variant)), &[words]);
    }
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("pico.safetensors");
    pico_weights().save(&path, Dtype::F16).unwrap();
    assert!(Checkpoint::open(&path, Some("pico:out_layers=0,1:alt_start=1")).is_ok());
    for contradicted in ["pico:out_layers=1", "alt_start=0", "sh_degree=2"] {
        assert!(matches!(Checkpoint::open(&path, Some(contradicted)), Err(Error::Argument { .. })), "{contradicted}");
    }
}

#[test]
fn configurations_that_we_do_not_compute_are_refused() {
    let tiny = golden("micro");
    for (entry, words) in [
        (dict(&[("scene_init_layer", int(1))]), "scene_init_layer: found 1, expected 0"),
        (dict(&[("backbone", dict(&[("alt_start", b"J\xff\xff\xff\xff".to_vec())]))]), "alt_start is no whole number"),
        (dict(&[("backbone", dict(&[("out_layers", text("all"))]))]), "out_layers is no list"),
    ] {
        let root = dict(&[("model", tensors(&tiny, wrapped)), ("conf", dict(&[("model", entry)]))]);
        assert_refused(open(&root, Some("out_layers=1,2")), &[words]);
    }
}

/// Strides of 0 give a tensor any size.
#[test]
fn sizes_that_no_network_has_are_refused() {
    let wide = |name: &str, width: usize| {
        let view = View { kind: "FloatStorage", key: "0", elements: 1, offset: 0, shape: &[width], strides: &[0] };
        [text(name), view.pickle(), b"s".to_vec()].concat()
    };
    let norm = "backbone.backbone.norm.weight";
    for (tensors, words) in [
        (
            [wide(norm, 1 << 30), wide("backbone.backbone.blocks.0.norm1.weight", 4)],
            "found tensors of width 1073741824",
        ),
        ([wide(norm, 64), wide("backbone.backbone.blocks.99999999.norm1.weight", 4)], "depth of"),
        ([wide(norm, 64), wide("backbone.backbone.blocks.18446744073709551615.norm1.weight", 4)], "depth of"),
        ([wide(norm, 64), wide("color_embed.proj.bias", 1 << 30)], "without a backbone"),
    ] {
        let root = [b"}".to_vec(), tensors.concat()].concat();
        assert_refused(open(&root, Some("out_layers=0:alt_start=0")), &[words]);
    }
}

/// Of numpy and the scheduler, in pickle protocol 2.
#[test]
fn plain_data_beside_the_model_is_read_over() {
    let dtype = [
        call("numpy", "dtype", &[text("f8"), b"\x89".to_vec(), b"\x88".to_vec()]),
        tuple(&[int(3), text("<"), b"N".to_vec(), b"N".to_vec(), b"N".to_vec(), b"J\xff\xff\xff\xff".to_vec(), int(0)]),
        b"b".to_vec(),
    ]
    .concat();
    let bytes = call("_codecs", "encode", &[text("\0\0\0\0\0\0\u{f8}?"), text("latin1")]);
    let root = dict(&[
        ("best", call("numpy.core.multiarray", "scalar", &[dtype.clone(), bytes.clone()])),
        ("last", call("numpy._core.multiarray", "scalar", &[dtype, bytes])),
        ("milestones", call("collections", "Counter", &[b"}(K\x05K\x01u".to_vec()])),
        (
            "history",
            [
                call("collections", "defaultdict", &[global("__builtin__", "list")]),
                text("a"),
                list(&[1]),
                b"s".to_vec(),
            ]
            .concat(),
        ),
        ("seen", call("__builtin__", "set", &[list(&[1, 2])])),
        ("dtype", global("torch", "float32")),
        ("digest", b"C\x03abc".to_vec()),
        ("model", tensors(&golden("micro"), wrapped)),
    ]);
    let opened = open(&root, Some("out_layers=1,2")).unwrap();
    assert_eq!(opened.architecture(), &Architecture { name: "custom".into(), ..golden("micro") });
}

#[test]
fn doubles_are_rounded_and_noted() {
    let seeded = pico_weights();
    let (mut pickles, mut storages) = (Vec::new(), Vec::new());
    for (i, (name, shape)) in seeded.parameters().iter().enumerate() {
        let strides = row_major(shape);
        let (key, elements) = (i.to_string(), shape.iter().product());
        pickles.push((
            name.clone(),
            View { kind: "DoubleStorage", key: &key, elements, offset: 0, shape, strides: &strides }.pickle(),
        ));
        // Off by less than half a step of f32.
        let values = read(&seeded, name).into_iter().map(|value| f64::from(value) * (1.0 + 1e-9));
        storages.push((format!("data/{key}"), values.flat_map(f64::to_le_bytes).collect::<Vec<u8>>()));
    }
    let named: Vec<_> = pickles.iter().map(|(name, pickle)| (name.as_str(), pickle.clone())).collect();
    let pickle = [b"\x80\x02".to_vec(), dict(&named), b".".to_vec()].concat();
    let mut entries = vec![("data.pkl", pickle.as_slice())];
    entries.extend(storages.iter().map(|(name, bytes)| (name.as_str(), bytes.as_slice())));
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("double.pt");
    std::fs::write(&path, archive(&entries, CompressionMethod::Stored)).unwrap();
    let opened = Checkpoint::open_architecture(&path, pico()).unwrap();
    assert_same_bits(&opened, &seeded);
    let note = format!("{} tensors of f64 are rounded to f32", seeded.parameters().len());
    assert!(opened.notes()[0].contains(&note), "{:?}", opened.notes());
    assert_eq!(opened.bytes(), 8 * pico().parameter_count() as u64);
}

/// Compiled models without metadata lose the wrapper unless names collide.
#[test]
fn wrappers_in_safetensors() {
    let folder = tempfile::tempdir().unwrap();
    let (path, converted) = (folder.path().join("wrapped.safetensors"), folder.path().join("plain.safetensors"));
    let all: Vec<_> = golden("micro").parameters().iter().map(|(name, shape)| (wrapped(name), shape.clone())).collect();
    write_zeros(&path, &all);
    convert(&path, &converted, Dtype::F16, Some("out_layers=1,2")).unwrap();
    assert_eq!(Checkpoint::open(&converted, None).unwrap().architecture().name, "custom");
}
