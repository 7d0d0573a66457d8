//! The encoding of ROS 2 messages (OMG CDR, plain), as far as images and commands need it.

/// Reads a message field by field. Each method returns `None` where the message is too short.
pub(super) struct Cdr<'a> {
    /// Without the header: alignment counts from here.
    body: &'a [u8],
    at: usize,
    is_little: bool,
}

impl<'a> Cdr<'a> {
    /// A message with its header of four bytes.
    pub(super) fn new(message: &'a [u8]) -> Option<Self> {
        let (header, body) = message.split_first_chunk::<4>()?;
        match header[1] {
            0 => Some(Self { body, at: 0, is_little: false }),
            1 => Some(Self { body, at: 0, is_little: true }),
            // Other encodings order fields differently.
            _ => None,
        }
    }

    pub(super) fn u8(&mut self) -> Option<u8> {
        self.take(1).map(|byte| byte[0])
    }

    pub(super) fn u32(&mut self) -> Option<u32> {
        let bytes = self.aligned()?;
        Some(if self.is_little { u32::from_le_bytes(bytes) } else { u32::from_be_bytes(bytes) })
    }

    pub(super) fn f32(&mut self) -> Option<f32> {
        self.u32().map(f32::from_bits)
    }

    pub(super) fn f64(&mut self) -> Option<f64> {
        let bytes = self.aligned()?;
        Some(if self.is_little { f64::from_le_bytes(bytes) } else { f64::from_be_bytes(bytes) })
    }

    /// A string without its end mark.
    pub(super) fn string(&mut self) -> Option<&'a str> {
        let bytes = self.bytes()?;
        std::str::from_utf8(bytes.strip_suffix(&[0]).unwrap_or(bytes)).ok()
    }

    /// A sequence of bytes.
    pub(super) fn bytes(&mut self) -> Option<&'a [u8]> {
        let length = self.u32()? as usize;
        self.take(length)
    }

    /// A sequence of anything else.
    pub(super) fn sequence<T>(
        &mut self,
        mut item: impl FnMut(&mut Self) -> Option<T>,
    ) -> Option<Vec<T>> {
        // The items are read one by one, so a length that lies ends at the end of the message.
        (0..self.u32()?).map(|_| item(self)).collect()
    }

    /// `std_msgs/Header`
    pub(super) fn header(&mut self) -> Option<()> {
        self.u32()?;
        self.u32()?;
        self.string().map(|_| ())
    }

    fn aligned<const N: usize>(&mut self) -> Option<[u8; N]> {
        self.at = self.at.checked_next_multiple_of(N)?;
        self.take(N)?.try_into().ok()
    }

    fn take(&mut self, length: usize) -> Option<&'a [u8]> {
        let end = self.at.checked_add(length)?;
        let taken = self.body.get(self.at..end)?;
        self.at = end;
        Some(taken)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn fields_are_aligned_and_ends_are_found() {
        let message = [
            0, 1, 0, 0, 7, 0, 0, 0, 2, 0, 0, 0, b'a', 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0xf0,
            0x3f,
        ];
        let mut cdr = Cdr::new(&message).unwrap();
        assert_eq!(cdr.u8(), Some(7));
        assert_eq!(cdr.string(), Some("a"));
        assert_eq!(cdr.f64(), Some(1.0));
        assert_eq!(cdr.u8(), None);
        let lying = [0, 1, 0, 0, 0xff, 0xff, 0xff, 0xff];
        assert_eq!(Cdr::new(&lying).unwrap().bytes(), None);
        assert!(Cdr::new(&lying).unwrap().sequence(Cdr::f32).is_none());
        assert!(Cdr::new(&[0, 3, 0, 0]).is_none());
    }
}
