use super::RefineSettings;
use crate::decode::exif_of;
use clap::ValueEnum;
use std::path::{Path, PathBuf};
use zipsplat::refine::{self, RefineResult};

/// Difference of EXIF exposures, in stops, beyond which exposures are learned.
const MIN_STOPS: f64 = 0.5;

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub(super) enum Exposure {
    /// If exposure time, aperture and ISO in the photos' EXIF differ by more than half a stop; else
    /// if a factor per photo and color explains 20 % of the squared error after a tenth of the
    /// steps, at least 10
    Auto,
    /// Never
    Off,
    /// From a tenth of the steps on, at least 10
    On,
}

impl Exposure {
    pub fn of_photos(self, photos: &[PathBuf]) -> refine::Exposure {
        match self {
            Self::Auto if stops(photos).is_some_and(|stops| stops > MIN_STOPS) => refine::Exposure::On,
            Self::Auto => refine::Exposure::Auto,
            Self::Off => refine::Exposure::Off,
            Self::On => refine::Exposure::On,
        }
    }
}

impl RefineSettings {
    /// Returns whether exposures were learned, and the rule that decided.
    pub(super) fn exposure_rule(&self, photos: &[PathBuf], refined: &RefineResult) -> String {
        let learned = if refined.exposures.is_some() { "learned" } else { "not learned" };
        let rule = match (self.exposure, stops(photos)) {
            (Exposure::Off, _) => "--exposure off".into(),
            (Exposure::On, _) => "--exposure on".into(),
            (Exposure::Auto, Some(stops)) if stops > MIN_STOPS => format!("EXIF exposures differ by {stops:.1} stops"),
            (Exposure::Auto, stops) => {
                let exif = stops.map_or("no EXIF exposures".into(), |stops| format!("EXIF: {stops:.1} stops"));
                format!("by the error that factors explain after the first steps ({exif})")
            }
        };
        format!("{learned}: {rule}")
    }
}

/// Returns the largest difference of the photos' EXIF exposures, in stops, if two or more have one.
fn stops(photos: &[PathBuf]) -> Option<f64> {
    let exposures: Vec<f64> = photos.iter().filter_map(|photo| exposure(photo)).collect();
    let bounds = exposures.iter().fold((f64::MAX, f64::MIN), |(low, high), of| (low.min(*of), high.max(*of)));
    (exposures.len() > 1).then_some(bounds.1 - bounds.0)
}

/// Base 2 logarithm of time times ISO over the squared f-number.
fn exposure(photo: &Path) -> Option<f64> {
    use exif::{In, Tag, Value};
    let read = exif_of(photo)?;
    let number = |tag| match &read.get_field(tag, In::PRIMARY)?.value {
        Value::Rational(found) => found.first().map(|number| number.to_f64()),
        value => value.get_uint(0).map(f64::from),
    };
    let [time, aperture, iso] = [Tag::ExposureTime, Tag::FNumber, Tag::PhotographicSensitivity].map(number);
    Some((time? * iso? / aperture?.powi(2)).log2()).filter(|exposure| exposure.is_finite())
}

#[cfg(test)]
mod tests {
    use super::*;
    use exif::{Field, In, Rational, Tag, Value, experimental::Writer};
    use std::io::Cursor;

    fn photo(folder: &Path, name: &str, values: &[(Tag, Value)]) -> PathBuf {
        let fields: Vec<Field> =
            values.iter().map(|(tag, value)| Field { tag: *tag, ifd_num: In::PRIMARY, value: value.clone() }).collect();
        let (mut writer, mut tiff) = (Writer::new(), Cursor::new(Vec::new()));
        fields.iter().for_each(|field| writer.push_field(field));
        writer.write(&mut tiff, true).expect("EXIF");
        let path = folder.join(name);
        std::fs::write(&path, tiff.into_inner()).expect("a file");
        path
    }

    #[test]
    fn exposures_by_exif_decide() {
        let folder = tempfile::tempdir().expect("a folder");
        let ratio = |num, denom| Value::Rational(vec![Rational { num, denom }]);
        let shot = |name: &str, time: u32, aperture: u32, iso: u16| {
            let values = [
                (Tag::ExposureTime, ratio(1, time)),
                (Tag::FNumber, ratio(aperture, 10)),
                (Tag::PhotographicSensitivity, Value::Short(vec![iso])),
            ];
            photo(folder.path(), name, &values)
        };
        let first = shot("1.tif", 100, 40, 200);
        let without = photo(folder.path(), "2.tif", &[(Tag::ExposureTime, ratio(1, 6400))]);
        assert_eq!(stops(&[first.clone(), without.clone(), folder.path().join("absent.jpg")]), None);
        for (other, expected) in [
            (shot("3.tif", 200, 40, 200), 1.0),
            (shot("4.tif", 100, 80, 200), 2.0),
            (shot("5.tif", 100, 40, 1600), 3.0),
            (shot("6.tif", 200, 40, 400), 0.0),
            (shot("7.tif", 125, 40, 200), 0.321_928),
            (shot("8.tif", 0, 40, 200), f64::NAN),
        ] {
            let photos = [first.clone(), without.clone(), other];
            let found = stops(&photos).unwrap_or(f64::NAN);
            assert!((found - expected).abs() < 1e-6 || found.is_nan() && expected.is_nan(), "{found}, {expected}");
            let learned = Exposure::Auto.of_photos(&photos);
            assert_eq!(learned == refine::Exposure::On, expected > MIN_STOPS, "{expected}");
            assert_eq!(Exposure::Off.of_photos(&photos), refine::Exposure::Off);
        }
    }
}
