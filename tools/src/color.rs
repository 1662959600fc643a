/// Basic CSS colors (Color Module Level 4), and `grey`.
const NAMED: [(&str, u32); 17] = [
    ("black", 0x000000),
    ("silver", 0xc0c0c0),
    ("gray", 0x808080),
    ("grey", 0x808080),
    ("white", 0xffffff),
    ("maroon", 0x800000),
    ("red", 0xff0000),
    ("purple", 0x800080),
    ("fuchsia", 0xff00ff),
    ("green", 0x008000),
    ("lime", 0x00ff00),
    ("olive", 0x808000),
    ("yellow", 0xffff00),
    ("navy", 0x000080),
    ("blue", 0x0000ff),
    ("teal", 0x008080),
    ("aqua", 0x00ffff),
];

pub fn parse(text: &str) -> Result<[f32; 3], String> {
    let text = text.trim();
    let color = match text.strip_prefix('#') {
        Some(digits) => hexadecimal(digits),
        None => NAMED.iter().find(|(name, _)| name.eq_ignore_ascii_case(text)).map(|(_, color)| *color),
    };
    let shares = || {
        let values: Option<Vec<f32>> = text.split(',').map(|value| value.trim().parse().ok()).collect();
        let inside = |color: &[f32; 3]| color.iter().all(|c| (0.0..=1.0).contains(c));
        values.and_then(|values| values.try_into().ok()).filter(inside)
    };
    let bytes = |color: u32| [16, 8, 0].map(|shift| (color >> shift & 0xff) as f32 / 255.0);
    color.map(bytes).or_else(shares).ok_or_else(|| {
        let names: Vec<&str> = NAMED.iter().map(|(name, _)| *name).collect();
        format!("expected red, green and blue from 0 to 1 such as 1,1,1, or '#ffffff', or one of {}", names.join(", "))
    })
}

fn hexadecimal(digits: &str) -> Option<u32> {
    let value =
        u32::from_str_radix(digits, 16).ok().filter(|_| digits.bytes().all(|digit| digit.is_ascii_hexdigit()))?;
    match digits.len() {
        6 => Some(value),
        3 => Some(0x11 * ((value & 0xf00) << 8 | (value & 0xf0) << 4 | value & 0xf)),
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use super::parse;

    #[test]
    fn colors_are_read() {
        for (text, color) in [
            ("#ffffff", [1.0; 3]),
            ("#F80", [1.0, 136.0 / 255.0, 0.0]),
            ("#ff8800", [1.0, 136.0 / 255.0, 0.0]),
            ("White", [1.0; 3]),
            ("lime", [0.0, 1.0, 0.0]),
            ("0, 0.5,1", [0.0, 0.5, 1.0]),
        ] {
            assert_eq!(parse(text), Ok(color), "{text}");
        }
        for text in ["", "#", "#12345", "#+12345", "#gggggg", "mauve", "1,1", "2,0,0", "1,1,1,1"] {
            assert!(parse(text).is_err_and(|reason| reason.contains("'#ffffff'")), "{text}");
        }
    }
}
