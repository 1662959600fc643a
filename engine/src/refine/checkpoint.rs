//! Checkpoints of a refinement: safetensors of its whole state, to resume with equal bits.

use super::{RefineOptions, adam::HostAdam};
use crate::{
    Error, Result,
    gpu::{Device, Resident, Tensor},
    random::mix,
    types::{Camera, Scene, Unfinished, open_file},
};
use bytemuck::Pod;
use safetensors::{Dtype, SafeTensorError, SafeTensors, tensor::TensorView};
use std::{
    collections::HashMap,
    fs::File,
    io::Read,
    path::{Path, PathBuf},
    time::Duration,
};

const VERSION_KEY: &str = "version";
const REMEDY: &str = "; delete the file to start over";
const VERSION: &str = concat!("3 of zipsplat ", env!("CARGO_PKG_VERSION"));

/// Checkpoint file; a refinement resumes from an existing one.
#[derive(Clone, Debug, PartialEq)]
pub struct RefineCheckpoint {
    /// Safetensors file, replaced atomically and kept after the refinement.
    pub path: PathBuf,
    /// Time between writes; an end by `progress` also writes.
    pub interval: Duration,
    /// Identity of the photos' contents, such as file names and times.
    pub photos: String,
}

/// Conditions that a checkpoint and its continuation share.
pub(super) type Identity = Vec<(&'static str, String)>;

/// State to write, or to read in the same order.
pub(super) enum State<'a> {
    Save(Vec<Values>),
    Load(SafeTensors<'a>, &'a Path),
}

pub(super) type Values = (String, Dtype, Vec<usize>, Vec<u8>);

pub(super) trait Element: Pod {
    const DTYPE: Dtype;
    const WIDTH: usize = 1;
}

impl Element for f32 {
    const DTYPE: Dtype = Dtype::F32;
}

impl Element for f64 {
    const DTYPE: Dtype = Dtype::F64;
}

impl Element for u64 {
    const DTYPE: Dtype = Dtype::U64;
}

impl<T: Element, const N: usize> Element for [T; N]
where
    [T; N]: Pod,
{
    const DTYPE: Dtype = T::DTYPE;
    const WIDTH: usize = N;
}

impl State<'_> {
    pub fn loads(&self) -> bool {
        matches!(self, Self::Load(..))
    }

    pub fn list<T: Element>(&mut self, name: impl AsRef<str>, list: &mut Vec<T>) -> Result<()> {
        let name = name.as_ref();
        match self {
            Self::Save(tensors) => {
                let bytes = bytemuck::cast_slice(list).to_vec();
                tensors.push((name.to_owned(), T::DTYPE, vec![list.len(), T::WIDTH], bytes));
            }
            Self::Load(tensors, path) => {
                let tensor = tensors.tensor(name).map_err(|error| damaged(path, error))?;
                if tensor.dtype() != T::DTYPE || tensor.shape().last() != Some(&T::WIDTH) {
                    return Err(damaged(path, format!("{name} of {:?} {:?}", tensor.dtype(), tensor.shape())));
                }
                *list = bytemuck::pod_collect_to_vec(tensor.data());
            }
        }
        Ok(())
    }

    /// A list of the same length on both sides.
    pub fn fixed<T: Element>(&mut self, name: &str, list: &mut [T]) -> Result<()> {
        let mut found = list.to_vec();
        self.list(name, &mut found)?;
        match self {
            Self::Load(_, path) if found.len() != list.len() => {
                Err(damaged(path, format!("{} elements of {name}", found.len())))
            }
            _ => {
                list.copy_from_slice(&found);
                Ok(())
            }
        }
    }

    pub fn mapped<T, U: Element>(
        &mut self,
        name: &str,
        values: &mut Vec<T>,
        to: impl Fn(&T) -> U,
        from: impl Fn(U) -> T,
    ) -> Result<()> {
        let mut numbers = values.iter().map(to).collect();
        self.list(name, &mut numbers)?;
        if self.loads() {
            *values = numbers.into_iter().map(from).collect();
        }
        Ok(())
    }

    pub fn count(&mut self, name: &str, count: &mut usize) -> Result<()> {
        let mut number = [*count as u64];
        self.fixed(name, &mut number)?;
        *count = number[0] as usize;
        Ok(())
    }

    /// Rows of moments and the number of steps, -1 for none.
    pub fn adams<const N: usize>(&mut self, name: &str, adams: &mut [Option<HostAdam<N>>]) -> Result<()> {
        let row = |adam: &Option<HostAdam<N>>| match adam {
            Some(HostAdam { first, second, steps }) => [&first[..], second, &[f64::from(*steps)]].concat(),
            None => vec![-1.0; 2 * N + 1],
        };
        let mut values: Vec<f64> = adams.iter().flat_map(row).collect();
        self.fixed(name, &mut values)?;
        for (adam, row) in adams.iter_mut().zip(values.chunks_exact(2 * N + 1)) {
            let part = |from: usize| std::array::from_fn(|i| row[from + i]);
            let read = HostAdam { first: part(0), second: part(N), steps: row[2 * N] as i32 };
            *adam = Some(read).filter(|adam| adam.steps >= 0);
        }
        Ok(())
    }

    pub fn tensor(&mut self, name: &str, memory: &Resident, tensor: Tensor) -> Result<()> {
        let mut values: Vec<f32> =
            if self.loads() { vec![0.0; tensor.bytes() as usize / 4] } else { memory.read(tensor)? };
        self.fixed(name, &mut values)?;
        if self.loads() { memory.write(tensor, &values) } else { Ok(()) }
    }

    pub fn scene(&mut self, name: &str, scene: &mut Scene) -> Result<()> {
        let named = |field: &str| format!("{name}.{field}");
        self.list(named("means"), &mut scene.means)?;
        self.list(named("scales"), &mut scene.scales)?;
        self.list(named("quats"), &mut scene.quats)?;
        self.list(named("opacities"), &mut scene.opacities)?;
        self.list(named("sh_coeffs"), &mut scene.sh_coeffs)
    }
}

impl RefineCheckpoint {
    /// Returns a checkpoint that is written each minute.
    pub fn new(path: PathBuf, photos: String) -> Self {
        Self { path, interval: Duration::from_secs(60), photos }
    }

    pub(super) fn read(&self) -> Result<Option<Vec<u8>>> {
        if !self.path.exists() {
            return Ok(None);
        }
        let mut bytes = Vec::new();
        let read = open_file(&self.path)?.read_to_end(&mut bytes);
        read.map(|_| Some(bytes)).map_err(|error| Error::io(&self.path, error))
    }

    /// Checks a file's identity and begins to load it.
    pub(super) fn open<'a>(&'a self, bytes: &'a [u8], identity: &Identity) -> Result<State<'a>> {
        let failed = |error| damaged(&self.path, error);
        let metadata = SafeTensors::read_metadata(bytes).map_err(failed)?.1.metadata().clone().unwrap_or_default();
        for (name, expected) in identity {
            match metadata.get(*name) {
                Some(found) if found == expected => {}
                Some(found) if *name == VERSION_KEY => {
                    let what = format!("version of the checkpoint {}", self.path.display());
                    return Err(Error::argument(what, found, format!("{expected}{REMEDY}")));
                }
                Some(_) => {
                    let found = format!("one of another refinement: its {name} differ");
                    let expected = format!("the same {name}{REMEDY}");
                    return Err(Error::argument(format!("checkpoint {}", self.path.display()), found, expected));
                }
                None => return Err(damaged(&self.path, format!("no {name}"))),
            }
        }
        Ok(State::Load(SafeTensors::deserialize(bytes).map_err(failed)?, &self.path))
    }

    pub(super) fn save(&self, identity: &Identity, values: &[Values]) -> Result<()> {
        let metadata: HashMap<String, String> =
            identity.iter().map(|(name, value)| ((*name).to_owned(), value.clone())).collect();
        let file = Unfinished::begin(&self.path)?;
        let failed = |error| Error::io(&self.path, error);
        let tensors: Result<Vec<_>, SafeTensorError> = values.iter().map(view).collect();
        tensors
            .and_then(|tensors| safetensors::serialize_to_file(tensors, Some(metadata), file.temporary_path()))
            .map_err(|error| failed(std::io::Error::other(error)))?;
        File::open(file.temporary_path()).and_then(|file| file.sync_all()).map_err(failed)?;
        file.finish()
    }
}

fn view((name, dtype, shape, bytes): &Values) -> Result<(&str, TensorView<'_>), SafeTensorError> {
    Ok((name, TensorView::new(*dtype, shape.clone(), bytes)?))
}

/// `start` is the initial values' hash.
pub(super) fn identity(
    checkpoint: &RefineCheckpoint,
    device: &Device,
    options: &RefineOptions,
    start: u64,
    cameras: &[Camera],
    sizes: &[[u32; 2]],
) -> Identity {
    let options =
        RefineOptions { checkpoint: None, snapshots: 0, profile: false, max_photo_bytes: 0, ..options.clone() };
    vec![
        (VERSION_KEY, VERSION.to_owned()),
        ("device", format!("{} {:?}", device.limits().name, device.limits().subgroup_size)),
        ("options", format!("{options:?}")),
        ("photos", format!("{sizes:?} {}", checkpoint.photos)),
        ("cameras", format!("{:016x}", hashed(0, format!("{cameras:?}").as_bytes()))),
        ("initial values", format!("{start:016x}")),
    ]
}

pub(super) fn hashed<T: Pod>(hash: u64, values: &[T]) -> u64 {
    let word = |bytes: &[u8]| bytes.iter().rev().fold(0, |word, byte| word << 8 | u64::from(*byte));
    let words = bytemuck::cast_slice(values).chunks(8).map(word);
    words.fold(mix(hash ^ values.len() as u64), |hash, word| mix(hash ^ word))
}

pub(super) fn hashed_scene(scene: &Scene) -> u64 {
    let Scene { means, scales, quats, opacities, sh_coeffs, antialiased, .. } = scene;
    let hash = hashed(hashed(hashed(u64::from(*antialiased), means), scales), quats);
    hashed(hashed(hash, opacities), sh_coeffs)
}

fn damaged(path: &Path, why: impl std::fmt::Display) -> Error {
    Error::format(path, None, format!("found a damaged or truncated checkpoint ({why}), expected a whole one{REMEDY}"))
}
