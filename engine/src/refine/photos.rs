use super::{
    depth::targets,
    schedule::phases,
    views::{View, fitted, resized},
};
use crate::{
    Error, Result,
    stages::depth_loss::DepthKind,
    types::{Camera, ColorTransform, Image, resample::resize_lanczos},
};
use rayon::prelude::*;
use std::{borrow::Cow, collections::HashMap, sync::Arc};

/// Photos by index, in memory or opened when needed.
pub trait Photos: Sync {
    /// Number of photos.
    fn count(&self) -> usize;

    /// Width and height of a photo in pixels.
    fn size(&self, i: usize) -> [u32; 2];

    /// Decodes a photo of this size, with any mask. Threads may open photos repeatedly and
    /// concurrently.
    ///
    /// # Errors
    /// An unreadable photo.
    fn open(&self, i: usize) -> Result<Cow<'_, Image>>;

    /// Known depth along the camera's axis by pixel, 0 if unknown; for
    /// [`RefineOptions::depth_loss`](super::RefineOptions::depth_loss).
    ///
    /// # Errors
    /// An unreadable depth map.
    fn depth(&self, _i: usize) -> Result<Option<Cow<'_, [f32]>>> {
        Ok(None)
    }
}

impl<T: AsRef<[Image]> + Sync> Photos for T {
    fn count(&self) -> usize {
        self.as_ref().len()
    }

    fn size(&self, i: usize) -> [u32; 2] {
        let photo = &self.as_ref()[i];
        [photo.width, photo.height]
    }

    fn open(&self, i: usize) -> Result<Cow<'_, Image>> {
        Ok(Cow::Borrowed(&self.as_ref()[i]))
    }
}

#[derive(Clone, Debug, PartialEq)]
struct Photo {
    image: Arc<Image>,
    depth: Option<Arc<[f32]>>,
}

impl Photo {
    fn bytes(&self) -> u64 {
        let mask = self.image.mask.as_ref().map_or(0, Vec::len);
        let depth = self.depth.as_ref().map_or(0, |depth| size_of_val(&**depth));
        (self.image.rgb.len() + mask + depth) as u64
    }
}

/// Photos at the coarse-to-fine sizes. Results are independent of the limit.
pub(super) struct PhotoCache<'a> {
    photos: &'a dyn Photos,
    max_size: Option<[u32; 2]>,
    coarse: bool,
    depth: Option<DepthKind>,
    pub left: u64,
    /// By photo and downscaling factor.
    kept: HashMap<(usize, u32), Photo>,
    /// Photos beyond the limit, until their use.
    ahead: HashMap<(usize, u32), Photo>,
}

impl<'a> PhotoCache<'a> {
    /// Photos fit `max_size`. If `coarse`, large ones are also downscaled.
    pub fn new(
        photos: &'a dyn Photos,
        max_size: Option<[u32; 2]>,
        coarse: bool,
        max_bytes: u64,
        depth: Option<DepthKind>,
    ) -> Self {
        Self { photos, max_size, coarse, depth, left: max_bytes, kept: HashMap::new(), ahead: HashMap::new() }
    }

    pub fn size(&self, i: usize, factor: u32) -> [u32; 2] {
        fitted(self.photos.size(i), self.max_size, factor)
    }

    pub fn camera(&self, i: usize, camera: &Camera, factor: u32) -> Result<Camera> {
        resized(i, camera, self.photos.size(i), self.size(i, factor))
    }

    fn factors(&self, i: usize) -> Vec<u32> {
        let [width, height] = self.size(i, 1);
        phases(self.coarse, width.min(height)).map(|(_, factor)| factor).collect()
    }

    /// Returns photos `now` with their cameras, as [`PhotoCache::get`].
    pub fn views(&mut self, cameras: &[Camera], now: &[usize], soon: &[usize], factor: u32) -> Result<Vec<View>> {
        let found = self.get(now, soon, factor)?;
        let view = |(photo, Photo { image, depth }): (&usize, Photo)| {
            let camera = self.camera(*photo, &cameras[*photo], factor)?;
            let (size, exposure) = (self.size(*photo, factor), ColorTransform::IDENTITY);
            Ok(View { photo: *photo, size, image, depth, camera, exposure })
        };
        now.iter().zip(found).map(view).collect()
    }

    /// Returns photos `now`. If one must be opened, idle threads open photos needed `soon`.
    fn get(&mut self, now: &[usize], soon: &[usize], factor: u32) -> Result<Vec<Photo>> {
        self.ahead.retain(|(photo, of), _| *of == factor && (now.contains(photo) || soon.contains(photo)));
        let mut lacking: Vec<usize> = Vec::new();
        for (at, photo) in now.iter().chain(soon).enumerate() {
            let is_known = self.find(*photo, factor).is_some() || lacking.contains(photo);
            let has_room = at < now.len() || (!lacking.is_empty() && lacking.len() < rayon::current_num_threads());
            if !is_known && has_room {
                lacking.push(*photo);
            }
        }
        let lacking = lacking.into_iter().map(|photo| (photo, self.reserve(photo))).collect();
        self.open_all(lacking, factor)?;
        Ok(now.iter().map(|photo| self.find(*photo, factor).expect("it was opened").clone()).collect())
    }

    /// Opens photos while they fit the limit.
    pub fn fill(&mut self, photos: &[usize]) -> Result<()> {
        let fitting = photos.iter().filter(|photo| !self.kept.contains_key(&(**photo, 1))).copied();
        let fitting: Vec<usize> = fitting.collect();
        let fitting = fitting.into_iter().filter(|photo| self.reserve(*photo)).map(|photo| (photo, true)).collect();
        self.open_all(fitting, 1)
    }

    /// Opens photos and keeps the flagged ones.
    fn open_all(&mut self, photos: Vec<(usize, bool)>, factor: u32) -> Result<()> {
        let opened = photos.into_par_iter().map(|(photo, keep)| {
            let photos = self.open(photo, if keep { self.factors(photo) } else { vec![factor] })?;
            Ok((keep, photos))
        });
        for opened in opened.collect::<Vec<Result<_>>>() {
            let (keep, photos) = opened?;
            if keep {
                let bytes: u64 = photos.iter().map(|(_, photo)| photo.bytes()).sum();
                self.left += self.most_bytes(photos[0].0.0) - bytes;
                self.kept.extend(photos);
            } else {
                self.ahead.extend(photos);
            }
        }
        Ok(())
    }

    fn find(&self, photo: usize, factor: u32) -> Option<&Photo> {
        self.kept.get(&(photo, factor)).or_else(|| self.ahead.get(&(photo, factor)))
    }

    fn reserve(&mut self, photo: usize) -> bool {
        let left = self.left.checked_sub(self.most_bytes(photo));
        self.left = left.unwrap_or(self.left);
        left.is_some()
    }

    /// Bytes of a photo at all factors, with mask and any depth.
    fn most_bytes(&self, photo: usize) -> u64 {
        let each = if self.depth.is_some() { 8 } else { 4 };
        let bytes = |factor: u32| each * self.size(photo, factor).into_iter().map(u64::from).product::<u64>();
        self.factors(photo).into_iter().map(bytes).sum()
    }

    fn open(&self, i: usize, factors: Vec<u32>) -> Result<Vec<((usize, u32), Photo)>> {
        let photo = self.photos.open(i)?;
        photo.validate()?;
        let hidden = photo.hidden();
        let ([width, height], expected) = ([photo.width, photo.height], self.photos.size(i));
        if [width, height] != expected {
            let expected = format!("{} x {}, as before", expected[0], expected[1]);
            return Err(Error::argument(format!("size of photo {i}"), format!("{width} x {height}"), expected));
        }
        let known = self.depth.map(|kind| Ok((self.photos.depth(i)?, kind))).transpose()?;
        let at = |factor: u32| {
            let size = self.size(i, factor);
            let image = resize_lanczos(&hidden, size[0], size[1])?;
            let depth = match &known {
                Some((Some(depth), kind)) => Some(targets(i, depth, expected, size, image.mask.as_deref(), *kind)?),
                _ => None,
            };
            Ok(((i, factor), Photo { image: Arc::new(image), depth }))
        };
        factors.into_iter().map(at).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::sync::atomic::{AtomicUsize, Ordering};

    struct Counted(Vec<Image>, AtomicUsize);

    impl Photos for Counted {
        fn count(&self) -> usize {
            self.0.len()
        }

        fn size(&self, i: usize) -> [u32; 2] {
            self.0.size(i)
        }

        fn open(&self, i: usize) -> Result<Cow<'_, Image>> {
            self.1.fetch_add(1, Ordering::Relaxed);
            self.0.open(i)
        }
    }

    #[test]
    fn photos_are_the_same_with_any_memory() {
        let photo = |i: u8| Image::new(240, 192, vec![40 * i; 3 * 240 * 192]).expect("a photo");
        let photos = Counted((0..6).map(photo).collect(), AtomicUsize::new(0));
        let bytes = |factor: usize| 3 * (240 / factor) * (192 / factor);
        let used = |max_bytes: usize| {
            let mut cache = PhotoCache::new(&photos, None, true, max_bytes as u64, None);
            photos.1.store(0, Ordering::Relaxed);
            let mut found = Vec::new();
            for (now, soon, factor) in
                [([0, 1], [2, 3], 2), ([2, 3], [4, 5], 2), ([5, 5], [0, 1], 1), ([0, 1], [2, 3], 1)]
            {
                found.extend(cache.get(&now, &soon, factor).expect("photos"));
                assert!(cache.ahead.len() <= 4 + rayon::current_num_threads());
            }
            (found, photos.1.load(Ordering::Relaxed))
        };
        let (all, opened) = used(usize::MAX);
        assert_eq!((all[0].image.rgb.len(), &*all[4].image), (bytes(2), &photos.0[5]));
        assert!((5..=6).contains(&opened), "{opened}");
        for max_bytes in [0, bytes(1) + bytes(2)] {
            let (found, more) = used(max_bytes);
            assert!(found == all && more > opened, "{max_bytes}: {more} of {opened}");
        }
    }

    #[test]
    fn masks_count_as_memory_of_photos() {
        let photo = |masked: bool| {
            let photo = Image::new(40, 30, vec![7; 3 * 1200]).expect("a photo");
            if masked { photo.with_mask(vec![255; 1200]).expect("a mask") } else { photo }
        };
        let photos = [photo(true), photo(false), photo(true)];
        let kept = |max_bytes: u64| {
            let mut cache = PhotoCache::new(&photos, None, true, max_bytes, None);
            cache.fill(&[0, 1, 2]).expect("photos");
            let mut kept: Vec<usize> = cache.kept.keys().map(|(photo, _)| *photo).collect();
            kept.sort_unstable();
            (kept, max_bytes - cache.left)
        };
        assert_eq!(kept(100_000), (vec![0, 1, 2], (4 + 3 + 4) * 1200));
        assert_eq!(kept(3 * 3 * 1200), (vec![0, 1], (4 + 3) * 1200));
        assert_eq!(kept(3 * 1200), (vec![], 0));
    }
}
