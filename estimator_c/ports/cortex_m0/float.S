// SPDX-License-Identifier: MIT
/// Arithmetic of float for processors that have neither that nor a long multiplication (ARMv6-M: Cortex-M0, M0+, M1):
/// the single-precision helpers of Arm's run-time ABI (RTABI32, 4.1.2 and 4.1.4), to be linked ahead of libgcc.
///
/// The results are those of IEEE 754 binary32 to the bit: rounded to nearest, ties to even, with subnormal numbers,
/// infinities and signed zeros. A NaN is 0x7FC00000, or an operand that is one. No flags, no traps, no state, no memory
/// but the stack (20 bytes); may be interrupted anywhere, and called from interrupts.
///
/// Each operation first tries a short way, for normal numbers of moderate size whose result is not close to a rounding
/// boundary; it takes 25 to 65 instructions. The rest goes to code that is exact for all numbers, and longer.
///
/// The operands are a (r0) and b (r1). "Sign and exponent" are the top nine bits of a float, as a number. A mantissa
/// has its leading one in bit 31, if not said otherwise, so that 8 bits of it are rounded away.

        .syntax unified
        .cpu    cortex-m0
        .thumb

/// A function of the ABI.
.macro  routine name
        .global \name
        .type   \name, %function
        .thumb_func
\name:
.endm

/// What every routine saves, and how it returns.
.macro  enter
        push    {r4-r7, lr}
.endm

.macro  leave
        pop     {r4-r7, pc}
.endm

/// The sign bit, which is the leading one of a mantissa as well.
.macro  top_bit to
        movs    \to, #1
        lsls    \to, \to, #31
.endm

/// r0 = the float of sign and exponent r2 and mantissa r3, of which the lowest bits are lost; a half is rounded up.
/// Where the leading one is still there, it adds 1 to the exponent.
.macro  compose lost
        lsls    r2, r2, #23
        lsrs    r0, r3, #\lost          // the carry is the highest bit that is lost
        adcs    r0, r0, r2              // may carry into the exponent, as it should
.endm

.macro  make_even
        movs    r1, #1
        bics    r0, r0, r1
.endm

/// To \rare unless |a| and |b| are of moderate size: the exponent of a in 64..191 and that of b in 85..170, so that
/// neither the product nor the quotient can overflow or be subnormal.
.macro  moderate rare
        lsls    r2, r0, #1
        adds    r2, r2, r2              // overflows if the exponent's two top bits differ
        bvc     \rare
        lsls    r2, r1, #1
        lsrs    r3, r2, #1
        adds    r2, r2, r3              // 1.5 times the exponent: 128..255 there, less below, and again less above
        bpl     \rare
.endm

        .section .note.GNU-stack, "", %progbits

        .section .text.float_arithmetic, "ax", %progbits
        .p2align 1

// ---- a - b, b - a, a + b

routine __aeabi_frsub
        enter
        top_bit r4
        eors    r0, r0, r4
        b       add

routine __aeabi_fsub
        enter
        top_bit r4
        eors    r1, r1, r4
        b       add

routine __aeabi_fadd
        enter
        top_bit r4
add:    lsls    r2, r0, #1
        lsls    r3, r1, #1
        cmp     r2, r3
        bhs     1f
        movs    r5, r0                  // |a| < |b|: exchange them
        movs    r0, r1
        movs    r1, r5
        lsls    r2, r0, #1
        lsls    r3, r1, #1
1:      lsrs    r3, r3, #24
        beq     add_rare                // b is zero or subnormal
        lsrs    r2, r2, #24
        cmp     r2, #254
        bhs     add_rare                // the sum may overflow, or a is no number
        subs    r7, r2, r3
        lsls    r5, r1, #8
        orrs    r5, r5, r4
        lsrs    r5, r5, r7              // the mantissa of b in units of that of a; what is lost is less than a unit
        lsls    r6, r0, #8
        orrs    r6, r6, r4
        lsrs    r2, r0, #23
        eors    r1, r1, r0
        bmi     subtract
        adds    r3, r6, r5
        bcs     3f
one_off:
        lsls    r3, r3, #1              // the leading one goes
2:      lsls    r5, r3, #24
        beq     4f
compose_sum:
        compose 9
        leave
3:      adds    r2, r2, #1              // the leading one went with the carry
        b       2b
4:      lsls    r5, r3, #23             // is it a half that is lost, or nothing of note?
        bpl     compose_sum
        cmp     r7, #8
        bhi     add_again               // even less may be lost beside it
        compose 9
        make_even                       // exactly a half
        leave

subtract:
        subs    r3, r6, r5
        bmi     one_off
        beq     equal
        uxtb    r5, r2
        cmp     r5, #25
        blo     add_again               // the difference may be subnormal
        subs    r2, r2, #1
        lsls    r3, r3, #1
        bmi     one_off
1:      lsrs    r5, r3, #24             // two places or more: the exponents differ by one at most, nothing was lost
        bne     2f
        subs    r2, r2, #8
        lsls    r3, r3, #8
        bpl     1b
        b       one_off
2:      subs    r2, r2, #1
        lsls    r3, r3, #1
        bpl     2b
        b       one_off
equal:  movs    r0, #0
        leave

add_again:
        eors    r1, r1, r0              // b again
add_rare:
        b       add_any

// ---- a * b

routine __aeabi_fmul
        enter
        moderate mul_rare
        lsrs    r2, r0, #23
        lsrs    r3, r1, #23
        adds    r2, r2, r3
        top_bit r4
        lsls    r3, r0, #8
        orrs    r3, r3, r4
        lsrs    r3, r3, #16             // a = 2^8 r3 + r6, with 24 bits
        uxtb    r6, r0
        lsls    r5, r1, #8
        orrs    r5, r5, r4
        lsrs    r5, r5, #16             // b = 2^8 r5 + r7
        uxtb    r7, r1
        muls    r6, r5, r6
        muls    r7, r3, r7
        adds    r6, r6, r7
        lsrs    r6, r6, #8
        muls    r3, r5, r3
        subs    r2, r2, #128            // leaves the carry set, for one more in r3:
        adcs    r3, r3, r6              // r3 - 1 <= a b / 2^16 < r3 + 1
        bmi     1f
        lsls    r6, r3, #26             // 7 bits are lost. Those below the highest ...
        lsrs    r6, r6, #27
        beq     2f                      // ... are 0 or 1: too close to a half
        compose 7
        leave
1:      lsls    r6, r3, #25             // the same with 8 bits
        lsrs    r6, r6, #26
        beq     2f
        adds    r2, r2, #1
        compose 8
        leave

2:      muls    r0, r1, r0              // the lower 23 bits of a b, whatever is above the mantissas
        lsrs    r1, r0, #16
        subs    r1, r1, r3
        lsls    r1, r1, #25
        asrs    r1, r1, #25
        adds    r2, r2, #1
        adds    r3, r3, r1              // exact: the integer part of a b / 2^16
        bmi     3f
        lsls    r3, r3, #1
        subs    r2, r2, #1
3:      lsls    r5, r3, #24
        lsls    r1, r0, #16             // the rest of it
        compose 8
        cmp     r1, #0
        bne     4f
        cmp     r5, r4
        bne     4f
        make_even                       // exactly a half
4:      leave

mul_rare:
        lsls    r3, r1, #1
        lsls    r2, r0, #1
        beq     1f
        cmp     r3, #0
        bne     mul_any
1:      orrs    r2, r2, r3              // a product with zero: the other one
        eors    r0, r0, r1
        lsrs    r2, r2, #24
        cmp     r2, #255
        beq     not_a_number
        lsrs    r0, r0, #31
        lsls    r0, r0, #31
        leave

not_a_number:
        ldr     r0, =0x7FC00000
        leave

// ---- a / b

routine __aeabi_fdiv
        enter
        moderate div_rare
        lsrs    r2, r0, #23
        lsrs    r3, r1, #23
        subs    r2, r2, r3
        adds    r2, r2, #126            // the leading one of the quotient will count
        top_bit r4
        lsls    r0, r0, #8
        orrs    r0, r0, r4
        lsrs    r0, r0, #8              // a, with 24 bits
        lsls    r1, r1, #8
        orrs    r1, r1, r4
        lsrs    r5, r1, #16
        adds    r5, r5, #1              // x = b 2^-24 in units of 2^-16, rounded up
        lsrs    r1, r1, #8              // b
        cmp     r0, r1
        bhs     1f
        lsls    r0, r0, #1
        subs    r2, r2, #1
1:      movs    r3, #187                // 1/x in units of 2^-15: 2.92 - 2 x, low or high by 8 % at most ...
        lsls    r3, r3, #9
        subs    r3, r3, r5
        .rept   2
        movs    r6, r3                  // ... and two steps of Newton's method, r <- r (2 - x r), low by 2^-13 at most
        muls    r6, r5, r6
        negs    r6, r6
        lsrs    r6, r6, #16
        muls    r3, r6, r3
        lsrs    r3, r3, #15
        .endr
        lsrs    r5, r0, #9              // a / b to 12 bits after the point, low by less than 2.01
        muls    r5, r3, r5
        lsrs    r5, r5, #18
        movs    r6, r5
        muls    r6, r1, r6
        lsls    r0, r0, #12
        subs    r0, r0, r6              // the remainder, in which the upper bits cancelled
        lsls    r5, r5, #12             // and 12 bits more, low by 2 at most
        lsrs    r6, r0, #9
        muls    r6, r3, r6
        lsrs    r6, r6, #18
        adds    r5, r5, r6
        muls    r6, r1, r6
        lsls    r0, r0, #12
        subs    r0, r0, r6
        cmp     r0, r1
        bhs     3f
2:      lsls    r2, r2, #23             // never half way between two floats, since a has 24 bits and this 25
        lsrs    r0, r5, #1
        adcs    r0, r0, r2
        leave
3:      adds    r5, r5, #1
        subs    r0, r0, r1
        cmp     r0, r1
        bhs     3b
        b       2b

// ---- the rare cases: exact for all numbers

div_rare:
        lsls    r2, r0, #1
        lsls    r3, r1, #1
        top_bit r4
        movs    r7, r0
        eors    r7, r7, r1
        ands    r7, r7, r4              // the sign
        movs    r5, #255
        lsls    r5, r5, #24
        cmp     r2, r5
        bhi     not_a_number
        cmp     r3, r5
        bhi     not_a_number
        cmp     r2, r3
        bne     1f
        cmp     r2, #0
        beq     not_a_number            // 0 / 0
        cmp     r2, r5
        beq     not_a_number            // infinity / infinity
1:      cmp     r2, r5
        beq     infinite
        cmp     r3, #0
        beq     infinite
        cmp     r2, #0
        beq     zero
        cmp     r3, r5
        beq     zero
        bl      unpack_both
        subs    r2, r3, r2
        adds    r2, r2, #127
        lsrs    r0, r0, #8
        lsrs    r5, r5, #8
        cmp     r5, r0
        bhs     2f
        lsls    r5, r5, #1
        subs    r2, r2, #1
2:      movs    r3, #1                  // 32 bits of the quotient, one by one, until this comes out
3:      cmp     r5, r0
        blo     4f
        subs    r5, r5, r0              // leaves the carry set
4:      adcs    r3, r3, r3
        bcs     5f
        lsls    r5, r5, #1
        b       3b
5:      b       pack_with_rest

mul_any:                                // neither is zero
        top_bit r4
        movs    r7, r0
        eors    r7, r7, r1
        ands    r7, r7, r4
        movs    r5, #255
        lsls    r5, r5, #24
        cmp     r2, r5
        bhi     not_a_number
        cmp     r3, r5
        bhi     not_a_number
        cmp     r2, r5
        beq     infinite
        cmp     r3, r5
        beq     infinite
        bl      unpack_both
        adds    r2, r2, r3
        subs    r2, r2, #126
        lsrs    r1, r5, #16
        lsrs    r6, r0, #16
        lsrs    r5, r5, #8
        lsrs    r0, r0, #8
        uxtb    r3, r0
        muls    r5, r0, r5              // the lower 32 of the product's 48 bits
        muls    r3, r1, r3
        lsrs    r3, r3, #8
        muls    r1, r6, r1
        adds    r3, r3, r1              // too small for the upper 32 by less than 2^16 ...
        lsrs    r1, r5, #16
        subs    r1, r1, r3
        uxth    r1, r1
        adds    r3, r3, r1              // ... so that the 16 that both have correct it
        lsls    r5, r5, #16
        cmp     r3, #0
        bmi     pack_with_rest
        lsls    r3, r3, #1              // the bit that follows goes with the rest
        subs    r2, r2, #1
        b       pack_with_rest

/// Of a and b, neither zero nor infinite: mantissa and exponent of a to r5 and r3, of b to r0 and r2.
unpack_both:
        mov     r12, lr
        movs    r6, r1
        bl      unpack
        movs    r5, r0
        movs    r3, r2
        movs    r0, r6
        bl      unpack
        bx      r12

/// The mantissa of the float r0 to r0, and its exponent to r2, below 1 if it is subnormal.
unpack: lsls    r2, r0, #1
        lsls    r0, r0, #8
        lsrs    r2, r2, #24
        beq     1f
        orrs    r0, r0, r4
        bx      lr
1:      movs    r2, #1
2:      subs    r2, r2, #1
        lsls    r0, r0, #1
        bpl     2b
        bx      lr

zero:   movs    r0, r7
        leave

infinite:
        movs    r0, #255
        lsls    r0, r0, #23
        orrs    r0, r0, r7
        leave

add_any:                                // |a| >= |b|
        lsls    r3, r1, #1
        bne     1f
        lsls    r2, r0, #1
        bne     2f
        ands    r0, r0, r1              // both are zero: -0 if both are negative
2:      leave
1:      lsls    r2, r0, #1
        movs    r5, #255
        lsls    r5, r5, #24
        cmp     r2, r5
        bhi     4f
        blo     3f
        cmp     r3, r5                  // a is infinite
        bne     2b
        cmp     r0, r1
        beq     2b
4:      b       not_a_number
3:      movs    r7, r0
        ands    r7, r7, r4
        lsls    r6, r1, #8
        lsrs    r3, r3, #24
        bne     5f
        movs    r3, #1                  // subnormal: the exponent of the smallest, without its leading one
        b       6f
5:      orrs    r6, r6, r4
6:      lsls    r5, r0, #8
        lsrs    r2, r2, #24
        bne     7f
        movs    r2, #1
        b       8f
7:      orrs    r5, r5, r4
8:      eors    r1, r1, r0              // its sign tells whether they differ
        subs    r0, r2, r3
        movs    r3, r6
        bl      shift_right
        cmp     r1, #0
        bmi     9f
        adds    r3, r5, r3
        bcc     normalize
        lsls    r5, r3, #31             // what is shifted out
        lsrs    r3, r3, #1
        orrs    r3, r3, r4
        adds    r2, r2, #1
        b       pack_with_rest
9:      subs    r3, r5, r3
        bne     normalize
        movs    r0, #0
        leave
normalize:
        cmp     r3, #0
        bmi     pack
        lsls    r3, r3, #1
        subs    r2, r2, #1
        b       normalize

/// Shifts r3 right by r0, in 0..255; its lowest bit then stands for all that is lost, too. (Beyond 32 places that bit
/// is lost as well, which makes no difference to a rounded result.) Clobbers r0 and r6.
shift_right:
        movs    r6, r3
        lsrs    r3, r3, r0
        negs    r0, r0
        adds    r0, r0, #32
        lsls    r6, r6, r0
        subs    r0, r6, #1
        sbcs    r6, r6, r0              // 1 unless it was zero
        orrs    r3, r3, r6
        bx      lr

/// As pack; what is not zero in r5 lies beyond the mantissa.
pack_with_rest:
        subs    r6, r5, #1
        sbcs    r5, r5, r6              // 1 unless it was zero
        orrs    r3, r3, r5

/// Returns the float of sign r7, exponent r2, of any size, and mantissa r3, whose lowest bit stands for all below, too.
pack:   cmp     r2, #255
        bge     infinite
        subs    r2, r2, #1              // the leading one will count
        bpl     1f
        negs    r0, r2
        bl      shift_right
        movs    r2, #0
1:      lsls    r2, r2, #23
        orrs    r2, r2, r7
        lsls    r5, r3, #24
        lsrs    r0, r3, #8
        adcs    r0, r0, r2
        cmp     r5, r4
        bne     3f
        make_even                       // exactly a half
3:      leave
        .ltorg

// ---- comparisons

        .section .text.float_comparison, "ax", %progbits
        .p2align 1

.macro  exchange
        movs    r2, r0
        movs    r0, r1
        movs    r1, r2
.endm

.macro  return value
        movs    r0, #\value
        bx      lr
.endm

/// r0 = 1 if a < b, or a = b and \equal is 1; else, and if one is no number, 0. Of two floats of one sign, that of
/// greater magnitude is the greater bit pattern; if it is a number, both are.
.macro  order equal, unless_below, unless_above
        movs    r2, r0
        eors    r2, r2, r1
        bmi     3f
        cmp     r0, #0
        bmi     2f
        cmp     r0, r1
        \unless_below 1f
        movs    r2, #255
        lsls    r2, r2, #23             // infinity
        cmp     r1, r2
        bhi     1f
        return  1
1:      return  0
2:      cmp     r0, r1                  // both are negative
        \unless_above 1b
        movs    r2, #1
        lsls    r2, r2, #31
        asrs    r2, r2, #8              // -infinity
        cmp     r0, r2
        bhi     1b
        return  1
3:      movs    r2, #\equal
        b       signs_differ
.endm

routine __aeabi_fcmpgt
        exchange
routine __aeabi_fcmplt
        order   0, bhs, bls

routine __aeabi_fcmpge
        exchange
routine __aeabi_fcmple
        order   1, bhi, blo

/// Returns r2 if both are zero, and otherwise as above.
signs_differ:
        lsrs    r3, r0, #31             // is a negative? then it is below b
        lsls    r0, r0, #1
        lsls    r1, r1, #1
        bne     1f
        cmp     r0, #0
        beq     2f
1:      movs    r2, #255
        lsls    r2, r2, #24
        cmp     r0, r2
        bhi     3f
        cmp     r1, r2
        bhi     3f
        movs    r2, r3
2:      movs    r0, r2
        bx      lr
3:      return  0

routine __aeabi_fcmpeq
        cmp     r0, r1
        beq     1f
        orrs    r0, r0, r1
        lsls    r0, r0, #1
        beq     2f                      // both are zero
        return  0
1:      lsls    r0, r0, #1
        movs    r1, #255
        lsls    r1, r1, #24
        cmp     r0, r1
        bls     2f
        return  0
2:      return  1

routine __aeabi_fcmpun
        movs    r2, #255
        lsls    r2, r2, #24
        lsls    r0, r0, #1
        cmp     r0, r2
        bhi     1f
        lsls    r1, r1, #1
        cmp     r1, r2
        bhi     1f
        return  0
1:      return  1

// ---- integers

        .section .text.float_conversion, "ax", %progbits
        .p2align 1

routine __aeabi_ui2f
        movs    r1, #0
        b       1f

routine __aeabi_i2f
        asrs    r1, r0, #31
        eors    r0, r0, r1
        subs    r0, r0, r1              // |a|
        lsls    r1, r1, #31             // the sign
1:      movs    r2, #127 + 30           // the exponent, were the leading one in bit 31; that will count
        lsrs    r3, r0, #16
        bne     1f
        subs    r2, r2, #16
        lsls    r0, r0, #16
        beq     5f
1:      lsrs    r3, r0, #24
        bne     2f
        subs    r2, r2, #8
        lsls    r0, r0, #8
2:      lsrs    r3, r0, #28
        bne     3f
        subs    r2, r2, #4
        lsls    r0, r0, #4
3:      cmp     r0, #0
        bmi     4f
        subs    r2, r2, #1
        lsls    r0, r0, #1
        b       3b
4:      lsls    r2, r2, #23
        orrs    r2, r2, r1
        lsls    r3, r0, #24             // what is lost
        lsrs    r0, r0, #8
        adcs    r0, r0, r2
        lsls    r3, r3, #1
        bne     5f
        bcc     5f
        make_even                       // exactly a half
5:      bx      lr

// Towards zero. Beyond the range of integers: its end. Of no number: 0.

routine __aeabi_f2iz
        asrs    r3, r0, #31             // 0 or, if negative, -1
        lsls    r1, r0, #1
        lsrs    r2, r1, #24
        negs    r2, r2
        adds    r2, r2, #127 + 31       // how far the mantissa is above the integer
        ble     1f
        lsls    r0, r0, #8
        top_bit r1
        orrs    r0, r0, r1
        lsrs    r0, r0, r2              // nothing remains of a subnormal number
        eors    r0, r0, r3
        subs    r0, r0, r3
        bx      lr
1:      movs    r2, #255
        lsls    r2, r2, #24
        cmp     r1, r2
        bhi     no_integer
        top_bit r0
        subs    r0, r0, #1
        eors    r0, r0, r3
        bx      lr

routine __aeabi_f2uiz
        lsrs    r2, r0, #23             // sign and exponent
        negs    r2, r2
        adds    r2, r2, #127 + 31
        bmi     1f
        lsls    r0, r0, #8
        top_bit r1
        orrs    r0, r0, r1
        lsrs    r0, r0, r2
        bx      lr
1:      movs    r2, #255
        lsls    r2, r2, #23
        cmp     r0, r2
        bhi     no_integer              // negative, or no number
        movs    r0, #0
        mvns    r0, r0
        bx      lr
no_integer:
        movs    r0, #0
        bx      lr
