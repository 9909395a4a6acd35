//! The numbers of a PLY file's elements.

use super::header::{Element, Format, Number};
use crate::{
    assets::mesh::error::{MeshError, MeshFault},
    text::{
        bytes::{Class, class},
        number::{round_to_single, scan_number_without_comment},
    },
};

/// Reads along the body.
pub(super) struct Body<'t> {
    pub(super) bytes: &'t [u8],
    pub(super) at: usize,
    pub(super) format: Format,
}

impl Body<'_> {
    /// Checks before the first element that the file is long enough for all.
    pub(super) fn check_left(&self, element: &Element<'_>, index: u64) -> Result<(), MeshError> {
        if index == 0 {
            let left = (self.bytes.len() - self.at) as u64;
            // The last number of a text needs no space after it.
            let least = element
                .count
                .saturating_mul(element.least_size(self.format) as u64)
                .saturating_sub(1);
            if element.properties.is_empty() && element.count > 0 {
                return Err(MeshFault::Missing("properties for one of its elements").of_file());
            }
            if least > left {
                let expected = least.saturating_add(self.at as u64);
                return Err(
                    MeshFault::Truncated { expected, found: self.bytes.len() as u64 }.of_file()
                );
            }
        }
        Ok(())
    }

    pub(super) fn number(&mut self, kind: Number) -> Result<f64, MeshFault> {
        if self.format == Format::Ascii {
            return self.ascii_number(kind);
        }
        let end = self.at + kind.size();
        let bytes = self.bytes.get(self.at..end).ok_or(MeshFault::EarlyEnd)?;
        self.at = end;
        let is_little = self.format == Format::Little;
        macro_rules! number {
            ($type:ty) => {{
                let bytes = bytes.try_into().expect("the slice has the number's size");
                f64::from(if is_little {
                    <$type>::from_le_bytes(bytes)
                } else {
                    <$type>::from_be_bytes(bytes)
                })
            }};
        }
        Ok(match kind {
            Number::Char => number!(i8),
            Number::Uchar => number!(u8),
            Number::Short => number!(i16),
            Number::Ushort => number!(u16),
            Number::Int => number!(i32),
            Number::Uint => number!(u32),
            Number::Float => number!(f32),
            Number::Double => number!(f64),
        })
    }

    /// Goes to the next word of a text.
    pub(super) fn skip_space(&mut self) {
        while self.format == Format::Ascii
            && self.bytes.get(self.at).is_some_and(|&byte| class(byte) == Class::Space)
        {
            self.at += 1;
        }
    }

    /// Goes to the next word or the end of a line.
    pub(super) fn skip_blanks(&mut self) {
        let is_blank = |&byte: &u8| byte != b'\n' && class(byte) == Class::Space;
        while self.bytes.get(self.at).is_some_and(is_blank) {
            self.at += 1;
        }
    }

    fn ascii_number(&mut self, kind: Number) -> Result<f64, MeshFault> {
        self.skip_space();
        let start = self.at;
        if start == self.bytes.len() {
            return Err(MeshFault::EarlyEnd);
        }
        let number =
            scan_number_without_comment(self.bytes, &mut self.at).ok_or(MeshFault::Number)?;
        if kind == Number::Float {
            let single = round_to_single(number, &self.bytes[start..self.at]);
            return Ok(f64::from(single.ok_or(MeshFault::Number)?));
        }
        Ok(number)
    }

    /// A number that is not negative and has no fraction.
    pub(super) fn whole(&mut self, kind: Number) -> Result<i64, MeshFault> {
        let number = self.number(kind)?;
        let whole = number as i64;
        if number >= 0.0 && whole as f64 == number && number < 1e15 {
            Ok(whole)
        } else {
            Err(MeshFault::Whole)
        }
    }
}
