//! Kernels with several element types: one module per combination.
//!
//! `#pragma element T` declares an element type `T`: f32, f16 or bf16. It defines the macros `T`
//! and `T4` (vector of four), `from_T(x)` and `from_T4(x)` to f32, and `to_T(x)` and `to_T4(x)`,
//! which round and saturate.
//!
//! `#pragma factor f16 bf16 i8` declares the type `FACTOR`, one of those listed. Floating-point
//! factors get the same macros and `pack_FACTOR4(x)`, four 16-bit factors in two words.

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Element {
    F32,
    F16,
    Bf16,
    I8,
}

impl Element {
    const ALL: [Element; 4] = [Element::F32, Element::F16, Element::Bf16, Element::I8];

    pub fn name(self) -> &'static str {
        ["f32", "f16", "bf16", "i8"][self as usize]
    }

    fn macros(self, t: &str) -> String {
        let halves = "#extension GL_EXT_shader_16bit_storage : require\n";
        match self {
            Element::F32 => format!(
                "#define {t} float\n#define {t}4 vec4\n#define from_{t}(x) (x)\n#define from_{t}4(x) (x)\n\
                 #define to_{t}(x) (x)\n#define to_{t}4(x) (x)\n"
            ),
            Element::F16 => format!(
                "{halves}#define {t} float16_t\n#define {t}4 f16vec4\n\
                 #define from_{t}(x) float(x)\n#define from_{t}4(x) vec4(x)\n\
                 #define to_{t}(x) float16_t(clamp(x, -65504.0, 65504.0))\n\
                 #define to_{t}4(x) f16vec4(clamp(x, -65504.0, 65504.0))\n"
            ),
            Element::Bf16 => format!(
                "{halves}{BF16_BITS}#define {t} uint16_t\n#define {t}4 u16vec4\n\
                 #define from_{t}(x) uintBitsToFloat(uint(x) << 16)\n\
                 #define from_{t}4(x) uintBitsToFloat(uvec4(x) << 16)\n\
                 #define to_{t}(x) uint16_t(bf16_bits(vec4(x))[0])\n#define to_{t}4(x) u16vec4(bf16_bits(x))\n"
            ),
            Element::I8 => String::new(),
        }
    }

    fn factor_macros(self) -> String {
        let (extension, component, sum, pack) = match self {
            Element::F32 => panic!("matrix units take no f32"),
            Element::F16 => (
                "GL_EXT_shader_explicit_arithmetic_types_float16",
                "float16_t",
                "float",
                "uvec2(packFloat2x16(f16vec2((value).xy)), packFloat2x16(f16vec2((value).zw)))",
            ),
            Element::Bf16 => ("GL_EXT_bfloat16", "bfloat16_t", "float", "bf16_packed(value)"),
            Element::I8 => ("GL_EXT_shader_explicit_arithmetic_types_int8", "int8_t", "int", "uvec2(0)"),
        };
        format!(
            "#extension {extension} : require\n{}#define FACTOR_COMPONENT {component}\n\
             #define FACTOR_SUM {sum}\n#define FACTOR_IS_F16 {}\n#define FACTOR_IS_I8 {}\n\
             #define pack_FACTOR4(value) {pack}\n",
            self.macros(FACTOR),
            u32::from(self == Element::F16),
            u32::from(self == Element::I8),
        )
    }
}

/// Rounds to nearest even. The clamp keeps the result finite.
const BF16_BITS: &str = "#ifndef BF16_BITS\n#define BF16_BITS\nuvec4 bf16_bits(vec4 x) {\n\
    uvec4 bits = floatBitsToUint(clamp(x, -3.3895313e38, 3.3895313e38));\n\
    return (bits + 0x7fffu + ((bits >> 16) & 1u)) >> 16;\n}\n\
    uvec2 bf16_packed(vec4 x) {\n    uvec4 bits = bf16_bits(x);\n    return bits.xz | bits.yw << 16;\n}\n#endif\n";

pub const FACTOR: &str = "FACTOR";

enum Declaration<'a> {
    Element(&'a str),
    Factor(Vec<Element>),
}

fn declaration(line: &str) -> Option<Declaration<'_>> {
    if let Some(name) = line.strip_prefix("#pragma element ") {
        return Some(Declaration::Element(name));
    }
    let types = line.strip_prefix("#pragma factor ")?.split(' ');
    let known = |word| Element::ALL.into_iter().find(|e| e.name() == word).unwrap_or_else(|| panic!("{line}: {word}"));
    Some(Declaration::Factor(types.map(known).collect()))
}

/// Every combination of types, f32 first.
pub fn choices(text: &str) -> Vec<Vec<(String, Element)>> {
    let mut choices = vec![Vec::new()];
    for declaration in text.lines().filter_map(declaration) {
        let (name, types) = match declaration {
            Declaration::Element(name) => (name, vec![Element::F32, Element::F16, Element::Bf16]),
            Declaration::Factor(types) => (FACTOR, types),
        };
        let with = |choice: &Vec<(String, Element)>| {
            let choice = choice.clone();
            types.clone().into_iter().map(move |element| [choice.clone(), vec![(name.into(), element)]].concat())
        };
        choices = choices.iter().flat_map(with).collect();
    }
    choices.retain(|choice| {
        let has = |element| choice.iter().any(|(_, e)| *e == element);
        !has(Element::Bf16) || !(has(Element::F16) || has(Element::I8))
    });
    choices
}

pub fn defined(text: &str, elements: &[(String, Element)]) -> String {
    let chosen = |name: &str| elements.iter().find(|(n, _)| n == name).expect("a choice of this text").1;
    let line = |line: &str| match declaration(line) {
        Some(Declaration::Element(name)) => chosen(name).macros(name),
        Some(Declaration::Factor(_)) => chosen(FACTOR).factor_macros(),
        None => format!("{line}\n"),
    };
    text.lines().map(line).collect()
}
