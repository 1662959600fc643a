use std::ops::RangeInclusive;

use super::{Architecture, contents::Conf};
use crate::{Error, Result};

/// `NAME[:FIELD=VALUE]...`, all parts optional.
#[derive(Debug)]
pub(super) struct Variant<'a> {
    pub name: Option<&'a str>,
    pub conf: Conf,
}

const FIELDS: &str = "out_layers=A,B,.., alt_start, rope_start, camera_heads, gaussians_per_token or sh_degree";
/// [`Architecture::validate`] is stricter.
const NUMBERS: RangeInclusive<usize> = 0..=1 << 16;

impl<'a> Variant<'a> {
    /// Parses a variant, whose fields override those of `conf`.
    pub fn parse(text: Option<&'a str>, mut conf: Conf) -> Result<Self> {
        let mut name = None;
        for (i, part) in text.into_iter().flat_map(|text| text.split(':')).enumerate() {
            let Some((field, value)) = part.split_once('=') else {
                if i > 0 {
                    return Err(Error::argument("variant", part, format!("FIELD=VALUE, of {FIELDS}")));
                }
                name = Some(part);
                continue;
            };
            let number = |text: &str| {
                let number = text.trim().parse().ok().filter(|number| NUMBERS.contains(number));
                number.ok_or_else(|| Error::argument(format!("{field} of the variant"), text, "a whole number"))
            };
            let place = match field {
                "out_layers" => {
                    conf.out_layers = Some(value.split(',').map(number).collect::<Result<_>>()?);
                    continue;
                }
                "alt_start" => &mut conf.alt_start,
                "rope_start" => &mut conf.rope_start,
                "camera_heads" => &mut conf.camera_heads,
                "gaussians_per_token" => &mut conf.gaussians_per_token,
                "sh_degree" => &mut conf.sh_degree,
                _ => return Err(Error::argument("field of the variant", field, FIELDS)),
            };
            *place = Some(number(value)?);
        }
        Ok(Self { name, conf })
    }

    pub fn check(&self, stated: &Architecture, file: &str) -> Result<()> {
        let Conf { out_layers, alt_start, rope_start, camera_heads, gaussians_per_token, sh_degree, .. } = &self.conf;
        if let Some(name) = self.name.filter(|name| *name != stated.name) {
            return Err(Error::argument("variant", name, format!("{}, as {file} says", stated.name)));
        }
        let numbers = [
            ("alt_start", alt_start, stated.alt_start),
            ("rope_start", rope_start, stated.rope_start),
            ("camera_heads", camera_heads, stated.camera_heads),
            ("gaussians_per_token", gaussians_per_token, stated.gaussians_per_token),
            ("sh_degree", sh_degree, stated.sh_degree),
        ];
        let differs = |field: &str, found: String, stated: String| {
            Err(Error::argument(format!("{field} of the variant"), found, format!("{stated}, as {file} says")))
        };
        for (field, given, stated) in numbers {
            if let Some(given) = given.filter(|given| *given != stated) {
                return differs(field, given.to_string(), stated.to_string());
            }
        }
        match out_layers {
            Some(given) if *given != stated.out_layers => {
                differs("out_layers", format!("{given:?}"), format!("{:?}", stated.out_layers))
            }
            _ => Ok(()),
        }
    }
}
